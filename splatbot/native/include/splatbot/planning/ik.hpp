// SPDX-License-Identifier: Apache-2.0
// Joint values that put a tool at a pose.
#pragma once

#include <span>

#include "splatbot/arm.hpp"

namespace splatbot::planning {

struct IkGoal {
  double target[12];  // T_world_tcp (3, 4), row-major
  double tool[12];    // T_link_tcp of the last link
};

// What is missing at the end [m] and [rad].
struct IkMiss {
  double position, angle;
};

// Walks q (joints,) towards the goal within the limits by damped least squares with the squared error as damping
// (Sugihara, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method", T-RO 2011).
IkMiss solve_ik(const Arm& arm, const IkGoal& goal, std::span<const double> lower, std::span<const double> upper,
                int most, std::span<double> q);

}  // namespace splatbot::planning
