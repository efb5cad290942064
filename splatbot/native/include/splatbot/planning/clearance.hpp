// SPDX-License-Identifier: Apache-2.0
// How much room an arm has along a path.
#pragma once

#include <span>

#include "splatbot/arm.hpp"

namespace splatbot::planning {

// A proven lower bound [m] of the clearance to the map along a path (N, joints), at most `cut`, or 0. It certifies
// the path for an arm with larger spheres. The first try is close to the clearance at some configurations, later ones
// bisect. There are `rounds` tries, and from the third on only those that fit into `seconds`.
double path_clearance(const Arm& arm, const CollisionField& field, std::span<const double> path, double cut, int rounds,
                      double seconds);

}  // namespace splatbot::planning
