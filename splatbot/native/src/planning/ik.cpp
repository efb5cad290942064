// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/ik.hpp"

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <algorithm>
#include <vector>

#include "splatbot/se3.hpp"

namespace splatbot::planning {

namespace {

constexpr double kConvergedError = 1e-9;  // [m] and [rad]
constexpr double kMinDamping = 1e-10;     // added to the damping, for a singular J at the goal
constexpr double kDampingScale = 0.05;    // damping for each unit of the squared error
constexpr double kMaxStep = 1.0;          // [rad] or [m] of a joint in one iteration

using Pose34 = Eigen::Map<const Eigen::Matrix<double, 3, 4, Eigen::RowMajor>>;

Pose pose_of(const double* rows) {
  Pose T = Pose::Identity();
  T.matrix().topRows<3>() = Pose34(rows);
  return T;
}

// Task-space error e = (p_goal - p, log(R_goal Rᵀ)), in the world's axes.
Vector6 pose_error(const Pose& current, const Pose& goal) {
  Vector6 e;
  e << goal.translation() - current.translation(), so3_log(goal.linear() * current.linear().transpose());
  return e;
}

// Column of the geometric Jacobian of a joint with axis z and origin o. It is (z x (p - o), z) for a revolute joint and
// (z, 0) for a prismatic joint.
Vector6 jacobian_column(const double* T_world_joint, bool prismatic, const Eigen::Vector3d& p) {
  const Pose34 T(T_world_joint);
  const Eigen::Vector3d z = T.col(2), o = T.col(3);
  Vector6 column = Vector6::Zero();
  if (prismatic) {
    column.head<3>() = z;
  } else {
    column << z.cross(p - o), z;
  }
  return column;
}

}  // namespace

IkResidual solve_ik(const Arm& arm, const IkGoal& goal, std::span<const double> lower, std::span<const double> upper,
                    int max_iterations, std::span<double> q) {
  const std::size_t n = q.size();
  std::vector<double> poses(16 * (n + 1));
  Eigen::Matrix<double, 6, Eigen::Dynamic> J(6, n);
  const Pose target = pose_of(goal.target), tool = pose_of(goal.tool);
  for (int iteration = 0;; ++iteration) {
    arm.forward(q, poses);
    const Pose current = pose_of(poses.data() + 16 * n) * tool;
    const Vector6 e = pose_error(current, target);
    const IkResidual residual{.position = e.head<3>().norm(), .angle = e.tail<3>().norm()};
    if ((residual.position < kConvergedError && residual.angle < kConvergedError) || iteration == max_iterations) {
      return residual;
    }
    for (std::size_t j = 0; j < n; ++j) {
      const bool prismatic = arm.view().joint[j].prismatic != 0;
      J.col(static_cast<Eigen::Index>(j)) = jacobian_column(poses.data() + 16 * (j + 1), prismatic, current.translation());
    }
    // Damped least squares: Δq = Jᵀ (J Jᵀ + λ I)⁻¹ e with λ = kDampingScale |e|² + kMinDamping.
    const Matrix6 A = J * J.transpose() + (kMinDamping + kDampingScale * e.squaredNorm()) * Matrix6::Identity();
    const Eigen::VectorXd step = J.transpose() * A.llt().solve(e);
    for (std::size_t j = 0; j < n; ++j) {
      q[j] = std::clamp(q[j] + std::clamp(step[static_cast<Eigen::Index>(j)], -kMaxStep, kMaxStep), lower[j], upper[j]);
    }
  }
}

}  // namespace splatbot::planning
