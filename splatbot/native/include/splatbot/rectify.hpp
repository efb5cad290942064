// SPDX-License-Identifier: Apache-2.0
// Images of a rolling shutter, and of depth at another time or place, as those of one instant at the colour camera.
#pragma once

#include <array>
#include <span>

#include "splatbot/depth.hpp"

namespace splatbot {

// Motion of a camera around the stamp of a frame: T_world_camera(s) = T_world_camera(0) exp(s ξ), s [s] after the stamp.
struct RowMotion {
  std::array<double, 6> twist{};  // ξ = (v [m/s], ω [rad/s])
  double readout = 0.0;           // [s] from the first row to the last
  double delay = 0.0;             // [s] of the middle row after the stamp
};

// out (H, W): depth [m] that the colour camera has at the stamp, 0 where missing. The depth camera has the same
// intrinsics and the pose T_color_depth (row-major 4x4). A pixel whose surface is not found within kRectifyTolerance is
// missing: surfaces of different depth meet there.
constexpr double kRectifyTolerance = 0.75;  // [px]
void rectify_depth(const DepthImage& depth, const Pinhole& camera, const RowMotion& motion,
                   std::span<const double, 16> T_color_depth, std::span<float> out);

// out (H, W, 2): the pixel (u, v) of the rolling-shutter image that shows each pixel of the image at the stamp. The
// depth is that of the stamp. A pixel without depth takes that of the last one in its row, or moves as if very far.
void rectify_map(const DepthImage& depth, const Pinhole& camera, const RowMotion& motion, std::span<float> out);

}  // namespace splatbot
