// SPDX-License-Identifier: Apache-2.0
// Rigid transforms SE(3) and their twists, on Eigen. Notation as in Barfoot, "State Estimation for Robotics", chapter 7.
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <array>
#include <span>

namespace splatbot {

using Pose = Eigen::Isometry3d;
using Vector6 = Eigen::Matrix<double, 6, 1>;  // twist (t, ω): translation [m], then rotation vector [rad]
using Matrix6 = Eigen::Matrix<double, 6, 6>;

// Bindings pass poses and matrices as row-major arrays.
Pose pose_from(std::span<const double, 16> T);
std::array<double, 16> array_from(const Pose& T);

template <int N>
std::array<double, N * N> array_from(const Eigen::Matrix<double, N, N>& M) {
  std::array<double, N * N> out;
  Eigen::Map<Eigen::Matrix<double, N, N, Eigen::RowMajor>>(out.data()) = M;
  return out;
}

// The skew-symmetric matrix [w]x with [w]x v = w x v.
Eigen::Matrix3d skew(const Eigen::Vector3d& w);

// Exponential map: exp(t, ω) = (R, V t) with θ = |ω|, K = [ω]x (Rodrigues' formula),
//   R = I + sin θ/θ K + (1 - cos θ)/θ² K²,   V = I + (1 - cos θ)/θ² K + (θ - sin θ)/θ³ K².
Pose se3_exp(const Vector6& twist);

// Logarithm of a transform that rotates by less than π. The translation is t - ω x t / 2, the first order of V⁻¹ t in ω.
Vector6 se3_log_near(const Pose& T);

// Rotation vector [rad] of a rotation matrix, up to and including a rotation by π.
Eigen::Vector3d so3_log(const Eigen::Matrix3d& R);

}  // namespace splatbot
