// SPDX-License-Identifier: Apache-2.0
// Code that the projections share.
#pragma once

#include "project.hpp"
#include "rows.hpp"

namespace splatbot::SPLATBOT_KERNELS {

// Index of the first value that is not finite, or n.
inline std::size_t first_not_finite(const float* values, std::size_t n) {
  std::uint32_t bad = 0;
  for (std::size_t i = 0; i < n; ++i) {
    std::uint32_t x;
    std::memcpy(&x, values + i, sizeof(x));
    bad |= static_cast<std::uint32_t>((x & 0x7f800000U) == 0x7f800000U);
  }
  if (bad == 0) {
    return n;
  }
  for (std::size_t i = 0; i < n; ++i) {
    std::uint32_t x;
    std::memcpy(&x, values + i, sizeof(x));
    if ((x & 0x7f800000U) == 0x7f800000U) {
      return i;
    }
  }
  return n;
}

// The first input of Gaussians [begin, end) that is not finite, if there is one.
template <class Args>
bool find_fault(const Args& args, std::size_t begin, std::size_t end, ProjectedBlock& out) {
  const bool harmonics = args.sh_degree >= 0;
  const float* fields[] = {args.means, args.quats, args.scales, args.covars, args.opacities, args.colors};
  const auto columns = static_cast<std::size_t>(harmonics ? 3 * args.coefficients : args.channels);
  const std::size_t widths[] = {3, 4, 3, 9, 1, columns};
  for (int f = 0; f < 6; ++f) {
    if (fields[f] == nullptr) {
      continue;
    }
    const std::size_t n = (end - begin) * widths[f];
    const std::size_t bad = first_not_finite(fields[f] + begin * widths[f], n);
    if (bad < n) {
      out.fault_field = f;
      out.fault_row = begin + bad / widths[f];
      return true;
    }
  }
  return false;
}

// Gradients of the camera's rotation, translation, intrinsics and motion, lane by lane until the end.
class CameraSums {
 public:
  SB_INLINE void add(const F (&rotation)[9], const F (&translation)[3], const F (&intrinsics)[4], int n) {
    alignas(64) float lanes[kStill][W];
    for (int i = 0; i < 9; ++i) {
      store(lanes[i], rotation[i]);
    }
    for (int i = 0; i < 3; ++i) {
      store(lanes[9 + i], translation[i]);
    }
    for (int i = 0; i < 4; ++i) {
      store(lanes[12 + i], intrinsics[i]);
    }
    for (int k = 0; k < kStill; ++k) {
      for (int i = 0; i < W; ++i) {
        sums_[k][i] += i < n ? static_cast<double>(lanes[k][i]) : 0.0;
      }
    }
  }

  SB_INLINE void add_motion(const F (&motion)[kMotionSums], int n) {
    alignas(64) float lanes[W];
    for (int k = 0; k < kMotionSums; ++k) {
      store(lanes, motion[k]);
      for (int i = 0; i < n; ++i) {
        sums_[kStill + k][i] += static_cast<double>(lanes[i]);
      }
    }
  }

  void write(double* to) const {
    for (int k = 0; k < kCameraSums; ++k) {
      to[k] = 0.0;
      for (int i = 0; i < W; ++i) {
        to[k] += sums_[k][i];
      }
    }
  }

 private:
  static constexpr int kStill = kCameraSums - kMotionSums;
  double sums_[kCameraSums][W] = {};
};

// From d loss / d a, a = camera rotation x Gaussian rotation, to d loss / d Gaussian rotation.
SB_INLINE void pull_back_axes(const CameraLanes& cam, const F* ga, F* r) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      r[3 * i + j] = fma(cam.r[i], ga[j], fma(cam.r[3 + i], ga[3 + j], cam.r[6 + i] * ga[6 + j]));
    }
  }
}

// From d loss / d Gaussian rotation to the gradient of the quaternion.
SB_INLINE void pull_back_rotation(const Projected& o, const F* r, F* quat) {
  const F two = set1(2.0F);
  const F w = o.unit[0], x = o.unit[1], y = o.unit[2], z = o.unit[3];
  F q[4];
  q[0] = two * fma(x, r[7] - r[5], fma(y, r[2] - r[6], z * (r[3] - r[1])));
  q[1] = two * (fma(y, r[1] + r[3], fma(z, r[2] + r[6], w * (r[7] - r[5]))) - two * x * (r[4] + r[8]));
  q[2] = two * (fma(x, r[1] + r[3], fma(z, r[5] + r[7], w * (r[2] - r[6]))) - two * y * (r[0] + r[8]));
  q[3] = two * (fma(x, r[2] + r[6], fma(y, r[5] + r[7], w * (r[3] - r[1]))) - two * z * (r[0] + r[4]));
  const F radial = fma(q[0], w, fma(q[1], x, fma(q[2], y, q[3] * z)));
  const F zero = set1(0.0F);
  for (int i = 0; i < 4; ++i) {
    quat[i] = select(o.quat_zero, zero, fnma(radial, o.unit[i], q[i]) / o.norm);
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
