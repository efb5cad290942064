// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/shortcut.hpp"

#include <algorithm>

namespace splatbot::planning {

namespace {
constexpr double kLeast = 1e-6;  // relative to the path: least saving of a change
}

Shortcut::Shortcut(Space& space, Configuration waypoints)
    : space_(&space), waypoints_(std::move(waypoints)), a_(space.size()), b_(space.size()), middle_(space.size()) {
  measure();
}

void Shortcut::measure() {
  along_.assign(1, 0.0);
  for (std::size_t i = 1; i < size(); ++i) {
    along_.push_back(along_.back() + space_->distance(at(i - 1), at(i)));
  }
}

// The point that far along the path; returns the edge it is on.
std::size_t Shortcut::place(double along, double* q) const {
  const auto above = std::upper_bound(along_.begin() + 1, along_.end() - 1, along);
  const auto edge = static_cast<std::size_t>(above - along_.begin()) - 1;
  const double length = along_[edge + 1] - along_[edge];
  const double t = length > 0.0 ? std::clamp((along - along_[edge]) / length, 0.0, 1.0) : 0.0;
  for (std::size_t d = 0; d < space_->size(); ++d) {
    q[d] = at(edge)[d] + t * (at(edge + 1)[d] - at(edge)[d]);
  }
  return edge;
}

bool Shortcut::improve(Random& random) {
  const double whole = cost();
  double from = random.uniform() * whole, to = random.uniform() * whole;
  if (from > to) {
    std::swap(from, to);
  }
  // Often from waypoint to waypoint: that saves most and leaves no partial edges to check.
  const bool corners = random.uniform() < 0.3;
  std::size_t first = place(from, a_.data()), last = place(to, b_.data());
  if (corners && size() > 2) {
    from = along_[first];
    to = along_[last + 1];
    std::copy_n(at(first), a_.size(), a_.data());
    std::copy_n(at(last + 1), b_.size(), b_.data());
  }
  if (first == last) {
    return false;
  }
  const double chord = space_->distance(a_.data(), b_.data());
  if (to - from - chord < kLeast * whole) {
    return false;
  }
  if (random.uniform() < 0.5) {
    return space_->free(a_.data(), b_.data()) && replace(first, last, {a_.data(), b_.data()});
  }
  // A point of the path between them, drawn towards the chord.
  const double share = 0.2 + 0.6 * random.uniform(), pull = random.uniform();
  place(from + share * (to - from), middle_.data());
  for (std::size_t d = 0; d < middle_.size(); ++d) {
    middle_[d] += pull * (a_[d] + share * (b_[d] - a_[d]) - middle_[d]);
  }
  const double length = space_->distance(a_.data(), middle_.data()) + space_->distance(middle_.data(), b_.data());
  return to - from - length >= kLeast * whole && space_->free(a_.data(), middle_.data()) &&
         space_->free(middle_.data(), b_.data()) && replace(first, last, {a_.data(), middle_.data(), b_.data()});
}

bool Shortcut::leave_out() {
  bool shorter = false;
  for (std::size_t i = 1; i + 1 < size();) {
    if (space_->free(at(i - 1), at(i + 1))) {
      const auto begin = waypoints_.begin() + static_cast<std::ptrdiff_t>(i * space_->size());
      waypoints_.erase(begin, begin + static_cast<std::ptrdiff_t>(space_->size()));
      shorter = true;
    } else {
      ++i;
    }
  }
  measure();
  return shorter;
}

// Waypoints up to `first`, the points, waypoints from `last` + 1 on.
bool Shortcut::replace(std::size_t first, std::size_t last, const std::vector<const double*>& points) {
  const std::size_t dims = space_->size();
  const double* begin = points.front();
  const double* end = points.back();
  const bool from_corner = std::equal(begin, begin + dims, at(first)), to_corner = std::equal(end, end + dims, at(last + 1));
  if ((!from_corner && !space_->free(at(first), begin)) || (!to_corner && !space_->free(end, at(last + 1)))) {
    return false;
  }
  Configuration changed(waypoints_.begin(), waypoints_.begin() + static_cast<std::ptrdiff_t>((first + 1) * dims));
  for (std::size_t i = from_corner ? 1 : 0; i < points.size() - (to_corner ? 1 : 0); ++i) {
    changed.insert(changed.end(), points[i], points[i] + dims);
  }
  changed.insert(changed.end(), waypoints_.begin() + static_cast<std::ptrdiff_t>((last + 1) * dims), waypoints_.end());
  waypoints_ = std::move(changed);
  measure();
  return true;
}

}  // namespace splatbot::planning
