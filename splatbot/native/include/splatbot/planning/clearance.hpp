// SPDX-License-Identifier: Apache-2.0
// How much room an arm has along a path.
#pragma once

#include <span>

#include "splatbot/arm.hpp"

namespace splatbot::planning {

// A proven lower bound [m] of the room to the map along a path (N, joints), at most `cut`; 0 if there is none. Found by
// certifying the path for an arm with larger spheres: nearly by the room seen at some configurations, then by what halving
// an interval suggests, `rounds` times in all and, but for the first two, no more than fit into `seconds`.
double path_clearance(const Arm& arm, const CollisionField& field, std::span<const double> path, double cut, int rounds,
                      double seconds);

}  // namespace splatbot::planning
