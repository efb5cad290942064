// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/neighbours.hpp"

#include <algorithm>
#include <limits>

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

// Squared distances of all; returns how many there are with the padding, which is far away.
std::size_t Neighbours::measure(const double* q) {
  for (std::size_t d = 0; d < dims_; ++d) {
    query_[d] = static_cast<float>(q[d]);
  }
  const std::size_t padded = (size_ + kPlanLanes - 1) / kPlanLanes * kPlanLanes;
  kernels().plan->squared_distances(coordinates_.data(), room_, dims_, query_.data(), padded, squared_.data());
  std::fill(squared_.begin() + static_cast<std::ptrdiff_t>(size_), squared_.begin() + static_cast<std::ptrdiff_t>(padded),
            std::numeric_limits<float>::infinity());
  return padded;
}

std::int32_t Neighbours::nearest(const double* q) {
  if (size_ == 0) {
    return -1;
  }
  const std::size_t padded = measure(q);
  const float least = kernels().plan->least(squared_.data(), padded);
  return static_cast<std::int32_t>(kernels().plan->first_at_most(squared_.data(), 0, padded, least));
}

std::span<const Neighbour> Neighbours::nearest(const double* q, std::size_t k) {
  found_.clear();
  if (size_ == 0 || k == 0) {
    return found_;
  }
  const std::size_t padded = measure(q);
  const auto next = kernels().plan->first_at_most;
  std::size_t i = 0;
  for (; i < std::min(k, size_); ++i) {
    found_.push_back({squared_[i], static_cast<std::int32_t>(i)});
  }
  std::make_heap(found_.begin(), found_.end(), nearer);
  // Equals of the farthest that came later are farther.
  for (i = next(squared_.data(), i, padded, found_.front().squared); i < size_;
       i = next(squared_.data(), i + 1, padded, found_.front().squared)) {
    const Neighbour one{squared_[i], static_cast<std::int32_t>(i)};
    if (nearer(one, found_.front())) {
      std::pop_heap(found_.begin(), found_.end(), nearer);
      found_.back() = one;
      std::push_heap(found_.begin(), found_.end(), nearer);
    }
  }
  return found_;
}

}  // namespace splatbot::planning
