// SPDX-License-Identifier: Apache-2.0
// The first path: RRT-Connect between the start and any number of goals (Kuffner and LaValle, ICRA 2000). The smaller
// of the two trees grows (Qureshi and Ayaz 2015; Kuffner and LaValle 2011).
#pragma once

#include <cstdint>
#include <span>

#include "splatbot/planning/sampler.hpp"
#include "splatbot/planning/tree.hpp"

namespace splatbot::planning {

class Connect {
 public:
  Connect(Space& space, Sampler& sampler, double range);

  // Grows both trees until they meet by a path cheaper than `bound`, time is up, or `iterations` are. True: they met.
  // `iterations` is lowered by those used.
  bool run(std::span<const double> start, Random& random, const Stop& stop, double bound, std::uint64_t& iterations);

  // After a meeting: the waypoints (N, dims) from the start to a goal.
  Configuration path() const;
  double cost() const { return trees_[0].cost(meeting_[0]) + trees_[1].cost(meeting_[1]); }

  const Tree& from_start() const noexcept { return trees_[0]; }
  const Tree& from_goals() const noexcept { return trees_[1]; }  // its roots are the goals, in their order
  std::int32_t meeting(int tree) const noexcept { return meeting_[tree]; }

 private:
  enum class Step { blocked, advanced, reached };

  void begin(std::span<const double> start);
  bool connect_directly(std::span<const double> start, const Stop& stop, double bound);
  bool sample(Random& random, double bound, double* q);
  double to_end(int tree, const double* q) const;
  Step extend(int tree, const double* toward, double bound);
  void met();

  Space* space_;
  Sampler* sampler_;
  double range_;
  Tree trees_[2];
  Configuration start_, sample_, step_;
  std::int32_t added_ = -1, meeting_[2] = {-1, -1};
  double widest_ = 0.0;
};

}  // namespace splatbot::planning
