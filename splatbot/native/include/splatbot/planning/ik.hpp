// SPDX-License-Identifier: Apache-2.0
// Inverse kinematics: joint values that put a tool at a pose.
#pragma once

#include <span>

#include "splatbot/arm.hpp"

namespace splatbot::planning {

struct IkGoal {
  double target[12];  // T_world_tcp (3, 4), row-major
  double tool[12];    // T_link_tcp of the last link
};

// Norms of the final error: position [m], angle [rad].
struct IkResidual {
  double position, angle;
};

// Moves the joint values q (joints,) to the goal within the limits, by damped least squares (Levenberg-Marquardt). The
// damping is proportional to the squared error: Sugihara, "Solvability-unconcerned inverse kinematics by the
// Levenberg-Marquardt method", T-RO 2011.
IkResidual solve_ik(const Arm& arm, const IkGoal& goal, std::span<const double> lower, std::span<const double> upper,
                    int max_iterations, std::span<double> q);

}  // namespace splatbot::planning
