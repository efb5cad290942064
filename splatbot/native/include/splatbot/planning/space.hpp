// SPDX-License-Identifier: Apache-2.0
// A box of configurations in which straight edges are free or not.
#pragma once

#include <atomic>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace splatbot::planning {

using Configuration = std::vector<double>;

class Space {
 public:
  // Throws std::invalid_argument if the limits differ in number, or a lower one is above its upper one.
  Space(std::span<const double> lower, std::span<const double> upper);
  virtual ~Space() = default;
  Space(const Space&) = delete;
  Space& operator=(const Space&) = delete;

  std::size_t size() const noexcept { return lower_.size(); }
  const double* lower() const noexcept { return lower_.data(); }
  const double* upper() const noexcept { return upper_.data(); }
  bool contains(const double* q) const;
  // Puts joints that cannot move where they are.
  void settle(double* q) const {
    for (std::size_t d = 0; d < lower_.size(); ++d) {
      q[d] = lower_[d] == upper_[d] ? lower_[d] : q[d];
    }
  }

  // Euclidean.
  double distance(const double* a, const double* b) const {
    double sum = 0.0;
    for (std::size_t d = 0; d < lower_.size(); ++d) {
      sum += (a[d] - b[d]) * (a[d] - b[d]);
    }
    return std::sqrt(sum);
  }

  // True if every configuration on the straight edge is free.
  bool free(const double* a, const double* b) {
    ++edges_;
    return check(a, b);
  }
  std::uint64_t edges() const noexcept { return edges_; }

 protected:
  virtual bool check(const double* a, const double* b) = 0;

 private:
  Configuration lower_, upper_;
  std::uint64_t edges_ = 0;
};

// When to give up.
class Stop {
 public:
  using Clock = std::chrono::steady_clock;

  Stop(double seconds, const std::atomic<bool>* cancelled) : begin_(Clock::now()), seconds_(seconds), cancelled_(cancelled) {}

  double elapsed() const { return std::chrono::duration<double>(Clock::now() - begin_).count(); }
  bool cancelled() const { return cancelled_ != nullptr && cancelled_->load(std::memory_order_relaxed); }
  bool now() const { return elapsed() >= seconds_ || cancelled(); }

 private:
  Clock::time_point begin_;
  double seconds_;
  const std::atomic<bool>* cancelled_;
};

}  // namespace splatbot::planning
