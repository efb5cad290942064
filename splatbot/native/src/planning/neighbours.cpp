// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/neighbours.hpp"

#include <algorithm>

#include "splatbot/kernels.hpp"
#include "splatbot/planning/kernels.hpp"

namespace splatbot::planning {

namespace {

bool nearer(const Neighbour& a, const Neighbour& b) {
  return a.squared < b.squared || (a.squared == b.squared && a.id < b.id);
}

}  // namespace

void Neighbours::add(const double* q) {
  if (size_ == room_) {
    grow();
  }
  for (std::size_t d = 0; d < dims_; ++d) {
    coordinates_[d * room_ + size_] = static_cast<float>(q[d]);
  }
  ++size_;
}

void Neighbours::grow() {
  const std::size_t room = std::max<std::size_t>(256, 2 * room_);
  std::vector<float> wider(dims_ * room, 0.0F);
  for (std::size_t d = 0; d < dims_; ++d) {
    std::copy_n(coordinates_.begin() + static_cast<std::ptrdiff_t>(d * room_), size_,
                wider.begin() + static_cast<std::ptrdiff_t>(d * room));
  }
  coordinates_ = std::move(wider);
  squared_.resize(room);
  room_ = room;
}

void Neighbours::measure(const double* q) {
  for (std::size_t d = 0; d < dims_; ++d) {
    query_[d] = static_cast<float>(q[d]);
  }
  const std::size_t padded = (size_ + kPlanLanes - 1) / kPlanLanes * kPlanLanes;
  kernels().plan->squared_distances(coordinates_.data(), room_, dims_, query_.data(), padded, squared_.data());
}

std::int32_t Neighbours::nearest(const double* q) {
  if (size_ == 0) {
    return -1;
  }
  measure(q);
  const auto end = squared_.begin() + static_cast<std::ptrdiff_t>(size_);
  return static_cast<std::int32_t>(std::min_element(squared_.begin(), end) - squared_.begin());
}

std::span<const Neighbour> Neighbours::nearest(const double* q, std::size_t k) {
  found_.clear();
  if (size_ == 0 || k == 0) {
    return found_;
  }
  measure(q);
  for (std::size_t i = 0; i < size_; ++i) {
    const Neighbour one{squared_[i], static_cast<std::int32_t>(i)};
    if (found_.size() < k) {
      found_.push_back(one);
      std::push_heap(found_.begin(), found_.end(), nearer);
    } else if (one.squared < found_.front().squared) {
      std::pop_heap(found_.begin(), found_.end(), nearer);
      found_.back() = one;
      std::push_heap(found_.begin(), found_.end(), nearer);
    }
  }
  return found_;
}

}  // namespace splatbot::planning
