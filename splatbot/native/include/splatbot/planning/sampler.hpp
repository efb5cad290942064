// SPDX-License-Identifier: Apache-2.0
// Where to look next: anywhere, or only where a path better than the best one can pass.
#pragma once

#include <cstddef>
#include <span>

#include "splatbot/planning/random.hpp"
#include "splatbot/planning/space.hpp"

namespace splatbot::planning {

class Sampler {
 public:
  // The start, and goals (K, dims).
  Sampler(const Space& space, std::span<const double> start, std::span<const double> goals);

  std::size_t goals() const noexcept { return distance_.size(); }
  const double* goal(std::size_t g) const { return goals_.data() + g * start_.size(); }

  // Least possible cost from q to a goal, and of a path through q.
  double to_goal(const double* q) const;
  double through(const double* q) const { return space_->distance(start_.data(), q) + to_goal(q); }

  void uniform(Random& random, double* q) const;

  // Uniform in the ellipsoid |q - start| + |q - goal| < bound of one of the goals within the limits (Gammell et al.,
  // "Informed RRT*", IROS 2014). False: no such place was found.
  bool informed(Random& random, double bound, double* q);

 private:
  const Space* space_;
  Configuration start_, goals_;
  std::vector<double> distance_;  // of each goal from the start
  std::vector<std::size_t> open_;
};

}  // namespace splatbot::planning
