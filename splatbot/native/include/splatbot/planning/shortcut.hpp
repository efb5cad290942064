// SPDX-License-Identifier: Apache-2.0
// Makes a path shorter where it stands: chords between two of its points, or two edges over a point nearer to the chord.
#pragma once

#include <cstddef>
#include <vector>

#include "splatbot/planning/random.hpp"
#include "splatbot/planning/space.hpp"

namespace splatbot::planning {

class Shortcut {
 public:
  // Waypoints (N, dims), N >= 2, whose edges are free.
  Shortcut(Space& space, Configuration waypoints);

  std::size_t size() const noexcept { return waypoints_.size() / space_->size(); }
  const Configuration& waypoints() const noexcept { return waypoints_; }
  double cost() const noexcept { return along_.back(); }

  // One attempt; every edge of the path remains free by a check of its own. True: it is shorter.
  bool improve(Random& random);

  // Leaves out waypoints whose neighbours can be joined. True: some were.
  bool leave_out();

 private:
  const double* at(std::size_t i) const { return waypoints_.data() + i * space_->size(); }
  std::size_t place(double along, double* q) const;
  void measure();
  bool replace(std::size_t first, std::size_t last, const std::vector<const double*>& points);

  Space* space_;
  Configuration waypoints_, a_, b_, middle_;
  std::vector<double> along_;  // length up to each waypoint
};

}  // namespace splatbot::planning
