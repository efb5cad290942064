// SPDX-License-Identifier: Apache-2.0
// Which of the configurations added so far are nearest: a scan in float32 of all of them, 16 at a time.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace splatbot::planning {

struct Neighbour {
  float squared;
  std::int32_t id;
};

class Neighbours {
 public:
  explicit Neighbours(std::size_t dims) : dims_(dims), query_(dims) {}

  std::size_t size() const noexcept { return size_; }
  std::size_t bytes() const noexcept { return (coordinates_.capacity() + squared_.capacity()) * sizeof(float); }
  void add(const double* q);  // its id is how many were there
  void clear() noexcept { size_ = 0; }

  // The nearest node, the lowest id among equals; -1 in an empty tree.
  std::int32_t nearest(const double* q);
  // The k nearest (or all), in no order.
  std::span<const Neighbour> nearest(const double* q, std::size_t k);

 private:
  std::size_t measure(const double* q);
  void grow();

  std::size_t dims_, size_ = 0, room_ = 0;
  std::vector<float> coordinates_;  // (dims, room)
  std::vector<float> query_, squared_;
  std::vector<Neighbour> found_;
};

}  // namespace splatbot::planning
