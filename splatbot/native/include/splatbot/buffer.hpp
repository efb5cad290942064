// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <memory>
#include <new>
#include <span>
#include <type_traits>

namespace splatbot {

// Memory on cache-line boundaries that grows and never shrinks; its contents are undefined after resize().
// Kept between calls, because fresh pages cost more than the work done in them.
template <class T>
class Buffer {
  static_assert(std::is_trivially_copyable_v<T>);

 public:
  static constexpr std::size_t kAlignment = 64;

  void resize(std::size_t size) {
    if (size > capacity_) {
      memory_.reset();
      capacity_ = 0;
      const std::size_t capacity = size + size / 4;
      memory_.reset(static_cast<T*>(::operator new(capacity * sizeof(T), std::align_val_t{kAlignment})));
      capacity_ = capacity;
    }
    size_ = size;
  }

  T* data() noexcept { return memory_.get(); }
  const T* data() const noexcept { return memory_.get(); }
  std::size_t size() const noexcept { return size_; }
  std::size_t capacity_bytes() const noexcept { return capacity_ * sizeof(T); }
  T& operator[](std::size_t i) noexcept { return memory_.get()[i]; }
  const T& operator[](std::size_t i) const noexcept { return memory_.get()[i]; }
  std::span<T> span() noexcept { return {data(), size_}; }
  std::span<const T> span() const noexcept { return {data(), size_}; }

 private:
  struct Release {
    void operator()(T* p) const noexcept { ::operator delete(p, std::align_val_t{kAlignment}); }
  };
  std::unique_ptr<T[], Release> memory_;
  std::size_t size_ = 0;
  std::size_t capacity_ = 0;
};

}  // namespace splatbot
