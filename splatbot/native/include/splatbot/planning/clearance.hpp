// SPDX-License-Identifier: Apache-2.0
// How much room an arm has along a path.
#pragma once

#include <span>

#include "splatbot/arm.hpp"

namespace splatbot::planning {

struct PathClearance {
  double least;  // [m] a proven lower bound of the room along the path
  double found;  // [m] the least room of the configurations looked at: an upper bound
  int asked;     // configurations looked at
};

// Branch and bound over the stretches of a path (N, joints): room at a stretch's middle less what any sphere moves from
// there to its ends, halved where that is least, until both bounds are within a tenth of each other or `most`
// configurations were asked. Room beyond `cut` [m] is not told apart.
PathClearance path_clearance(const Arm& arm, const CollisionField& field, std::span<const double> path, double cut, int most);

}  // namespace splatbot::planning
