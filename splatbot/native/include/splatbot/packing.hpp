// SPDX-License-Identifier: Apache-2.0
// Leaves of the collision field in 18 instead of 56 bytes an ellipsoid, relative to a block of space. The mean takes
// 16 bits an axis, the rotation 32 (the three smaller components of the quaternion). The semi-axes take 10 bits each,
// rounded up. Every distance is reduced by the largest shift of a surface, so that certified answers stay certified.
//
// An ellipsoid of mean m, rotation R and semi-axes A reaches n.m + |A R' n| along a unit n. Let the packed mean
// deviate by at most kPackedOff, the rotation by an angle of at most kPackedTurn, and no semi-axis be smaller. The
// packed one then reaches at least as far, less kPackedOff + kPackedTurn max(A).
#pragma once

#include <cstdint>
#include <cstring>

#include "splatbot/solids.hpp"

#define SB_SHARED static inline __attribute__((always_inline))  // by kernels of any instruction set

namespace splatbot {

inline constexpr float kPackedStep = kBlockEdge / 65536.0F;  // [m]
inline constexpr float kPackedOff = 1.7321F * kPackedStep;   // [m] the last step rounds down
// Components deviate by half a step of sqrt(2)/1023, and so by at most sqrt(3)/2 of a step in total. On the sphere of
// unit quaternions that is at most twice as far, as the omitted component is at least 1/2. A rotation turns by twice
// that.
inline constexpr float kPackedTurn = 4.85e-3F;  // [rad]
inline constexpr float kTurnStep = 1.3824180e-3F;
inline constexpr float kPackedLeast = 1.0F / 32768.0F;  // [m] thinner ellipsoids are made as thick
inline constexpr std::uint32_t kAxisBase = 112U << 23;  // bits of kPackedLeast

SB_SHARED float axis_of_bits(std::uint32_t code) {
  const std::uint32_t bits = (code << 17) + kAxisBase;  // 4 bits of exponent, 6 of mantissa
  float x;
  std::memcpy(&x, &bits, sizeof(x));
  return x;
}

// The lanes of a packed leaf, as a leaf.
SB_SHARED void unpack(const PackedLeaf& from, const float* origin, SolidLeaf& to) {
  for (int k = 0; k < 3; ++k) {
    for (int i = 0; i < kFan; ++i) {
      to.mean[k][i] = origin[k] + static_cast<float>(from.mean[k][i]) * kPackedStep;  // exact
      to.axes[k][i] = axis_of_bits((from.axes[i] >> (10 * k)) & 1023U);
    }
  }
  for (int i = 0; i < kFan; ++i) {
    const std::uint32_t turn = from.turn[i], which = turn >> 30;
    const float a = (static_cast<float>(static_cast<std::int32_t>(turn & 1023U)) - 511.5F) * kTurnStep;
    const float b = (static_cast<float>(static_cast<std::int32_t>((turn >> 10) & 1023U)) - 511.5F) * kTurnStep;
    const float c = (static_cast<float>(static_cast<std::int32_t>((turn >> 20) & 1023U)) - 511.5F) * kTurnStep;
    const float rest = 1.0F - (a * a + b * b + c * c);
    const float w = __builtin_sqrtf(rest > 0.0F ? rest : 0.0F);
    to.quat[0][i] = which == 0 ? w : a;
    to.quat[1][i] = which == 1 ? w : which == 0 ? a : b;
    to.quat[2][i] = which == 2 ? w : which < 2 ? b : c;
    to.quat[3][i] = which == 3 ? w : c;
    to.id[i] = from.id[i];
  }
}

}  // namespace splatbot
