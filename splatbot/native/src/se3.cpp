// SPDX-License-Identifier: Apache-2.0
#include "splatbot/se3.hpp"

#include <algorithm>
#include <cmath>

namespace splatbot {
namespace {

using RowMajor4 = Eigen::Matrix<double, 4, 4, Eigen::RowMajor>;

constexpr double kSeriesBelow = 1e-4;  // [rad] angles below use the Taylor series of the coefficients
constexpr double kSineFloor = 1e-6;    // sines below leave the rotation axis undefined by the skew part of R

// The skew-symmetric part of R as a vector: (R - Rᵀ)/2 = sin θ [axis]x.
Eigen::Vector3d sine_axis(const Eigen::Matrix3d& R) {
  return 0.5 * Eigen::Vector3d(R(2, 1) - R(1, 2), R(0, 2) - R(2, 0), R(1, 0) - R(0, 1));
}

}  // namespace

Pose pose_from(std::span<const double, 16> T) {
  Pose pose;
  pose.matrix() = Eigen::Map<const RowMajor4>(T.data());
  return pose;
}

std::array<double, 16> array_from(const Pose& T) {
  std::array<double, 16> out;
  Eigen::Map<RowMajor4>(out.data()) = T.matrix();
  return out;
}

Eigen::Matrix3d skew(const Eigen::Vector3d& w) {
  Eigen::Matrix3d K;
  K << 0.0, -w.z(), w.y(), w.z(), 0.0, -w.x(), -w.y(), w.x(), 0.0;
  return K;
}

Pose se3_exp(const Vector6& twist) {
  const Eigen::Vector3d t = twist.head<3>(), w = twist.tail<3>();
  const double theta2 = w.squaredNorm(), theta = std::sqrt(theta2), half = 0.5 * theta;
  const bool series = theta < kSeriesBelow;
  const double a = series ? 1.0 - theta2 / 6.0 : std::sin(theta) / theta;
  const double b = series ? 0.5 - theta2 / 24.0 : 0.5 * std::pow(std::sin(half) / half, 2);
  const double c = series ? 1.0 / 6.0 - theta2 / 120.0 : (1.0 - a) / theta2;
  const Eigen::Matrix3d K = skew(w), K2 = K * K, I = Eigen::Matrix3d::Identity();
  Pose T = Pose::Identity();
  T.linear() = I + a * K + b * K2;
  T.translation() = (I + b * K + c * K2) * t;
  return T;
}

Vector6 se3_log_near(const Pose& T) {
  const Eigen::Matrix3d R = T.linear();
  const Eigen::Vector3d t = T.translation(), v = sine_axis(R);
  const double sine = v.norm(), cosine = 0.5 * (R.trace() - 1.0);
  const Eigen::Vector3d w = (sine < kSineFloor ? 1.0 : std::atan2(sine, cosine) / sine) * v;
  Vector6 twist;
  twist << t - 0.5 * w.cross(t), w;
  return twist;
}

Eigen::Vector3d so3_log(const Eigen::Matrix3d& R) {
  const Eigen::Vector3d v = sine_axis(R);
  const double sine = v.norm(), cosine = 0.5 * (R.trace() - 1.0), angle = std::atan2(sine, cosine);
  if (sine > 0.5 * kSineFloor) return angle / sine * v;
  if (cosine > 0.0) return v;
  // θ is close to π, where R = 2 axis axisᵀ - I: the column of the largest diagonal element gives the axis.
  Eigen::Index k = 0;
  R.diagonal().maxCoeff(&k);
  const double largest = std::sqrt(std::max(0.0, 0.5 * (R(k, k) + 1.0)));
  Eigen::Vector3d axis = (R.col(k) + R.row(k).transpose()) / (4.0 * largest);
  axis[k] = largest;
  return angle * axis;
}

}  // namespace splatbot
