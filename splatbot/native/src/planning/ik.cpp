// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/ik.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace splatbot::planning {

namespace {

constexpr double kDone = 1e-9;      // [m] and [rad]
constexpr double kLeastDamping = 1e-10;

// c = a b for poses (3, 4); b may be (4, 4).
void compose(const double* a, const double* b, double* c) {
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 4; ++k) {
      c[4 * i + k] = a[4 * i] * b[k] + a[4 * i + 1] * b[4 + k] + a[4 * i + 2] * b[8 + k] + (k == 3 ? a[4 * i + 3] : 0.0);
    }
  }
}

// Translation and rotation vector from `now` to `wanted`, along the world's axes.
void error_between(const double* now, const double* wanted, double* e) {
  double R[9];  // wanted now^T
  for (int i = 0; i < 3; ++i) {
    e[i] = wanted[4 * i + 3] - now[4 * i + 3];
    for (int k = 0; k < 3; ++k) {
      R[3 * i + k] = wanted[4 * i] * now[4 * k] + wanted[4 * i + 1] * now[4 * k + 1] + wanted[4 * i + 2] * now[4 * k + 2];
    }
  }
  double axis[3] = {R[7] - R[5], R[2] - R[6], R[3] - R[1]};
  const double twice_sine = std::hypot(axis[0], axis[1], axis[2]), twice_cosine = R[0] + R[4] + R[8] - 1.0;
  const double angle = std::atan2(twice_sine, twice_cosine);
  if (twice_sine > 1e-6) {
    for (int i = 0; i < 3; ++i) {
      e[3 + i] = axis[i] * angle / twice_sine;
    }
    return;
  }
  if (twice_cosine > 0.0) {
    for (int i = 0; i < 3; ++i) {
      e[3 + i] = 0.5 * axis[i];
    }
    return;
  }
  const int k = R[0] > R[4] && R[0] > R[8] ? 0 : R[4] > R[8] ? 1 : 2;  // half a turn: R = 2 a a' - 1
  const double a = std::sqrt(std::max(0.0, 0.5 * (R[4 * k] + 1.0)));
  for (int i = 0; i < 3; ++i) {
    e[3 + i] = angle * (i == k ? a : (R[3 * i + k] + R[3 * k + i]) / (4.0 * a));
  }
}

// x with A x = b for a symmetric positive definite A (6, 6), by Cholesky; b becomes x.
void solve(double (&A)[6][6], double (&b)[6]) {
  for (int i = 0; i < 6; ++i) {
    for (int j = 0; j <= i; ++j) {
      double sum = A[i][j];
      for (int k = 0; k < j; ++k) {
        sum -= A[i][k] * A[j][k];
      }
      A[i][j] = i == j ? std::sqrt(std::max(sum, 1e-300)) : sum / A[j][j];
    }
  }
  for (int i = 0; i < 6; ++i) {
    for (int k = 0; k < i; ++k) {
      b[i] -= A[i][k] * b[k];
    }
    b[i] /= A[i][i];
  }
  for (int i = 5; i >= 0; --i) {
    for (int k = i + 1; k < 6; ++k) {
      b[i] -= A[k][i] * b[k];
    }
    b[i] /= A[i][i];
  }
}

}  // namespace

IkMiss solve_ik(const Arm& arm, const IkGoal& goal, std::span<const double> lower, std::span<const double> upper,
                int most, std::span<double> q) {
  const std::size_t n = q.size();
  std::vector<double> poses(16 * (n + 1));
  std::vector<double> J(6 * n);
  double now[12], e[6] = {};
  IkMiss miss{};
  for (int round = 0;; ++round) {
    arm.forward(q, poses);
    compose(poses.data() + 16 * n, goal.tool, now);
    error_between(now, goal.target, e);
    miss = {std::hypot(e[0], e[1], e[2]), std::hypot(e[3], e[4], e[5])};
    if ((miss.position < kDone && miss.angle < kDone) || round == most) {
      return miss;
    }
    double A[6][6] = {}, b[6];
    for (std::size_t j = 0; j < n; ++j) {
      const double* T = poses.data() + 16 * (j + 1);
      const double z[3] = {T[2], T[6], T[10]}, r[3] = {now[3] - T[3], now[7] - T[7], now[11] - T[11]};
      double* column = J.data() + 6 * j;
      const bool slides = arm.view().joint[j].prismatic != 0;
      for (std::size_t i = 0; i < 3; ++i) {
        const std::size_t a = (i + 1) % 3, c = (i + 2) % 3;
        column[i] = slides ? z[i] : z[a] * r[c] - z[c] * r[a];
        column[3 + i] = slides ? 0.0 : z[i];
      }
      for (int i = 0; i < 6; ++i) {
        for (int k = 0; k <= i; ++k) {
          A[i][k] += column[i] * column[k];
        }
      }
    }
    double damping = kLeastDamping;
    for (int i = 0; i < 6; ++i) {
      damping += 0.05 * e[i] * e[i];
      b[i] = e[i];
    }
    for (int i = 0; i < 6; ++i) {
      A[i][i] += damping;
    }
    solve(A, b);
    for (std::size_t j = 0; j < n; ++j) {
      double step = 0.0;
      for (std::size_t i = 0; i < 6; ++i) {
        step += J[6 * j + i] * b[i];
      }
      q[j] = std::clamp(q[j] + std::clamp(step, -1.0, 1.0), lower[j], upper[j]);
    }
  }
}

}  // namespace splatbot::planning
