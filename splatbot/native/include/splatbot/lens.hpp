// SPDX-License-Identifier: Apache-2.0
// How a camera maps points of its own frame to pixels.
#pragma once

#include <cstdint>

namespace splatbot {

enum class CameraModel : std::uint8_t {
  pinhole,
  ortho,    // u = fx x + cx, v = fy y + cy; fx, fy [px/m]
  fisheye,  // equidistant: the distance from the principal point is f times the angle from the axis
};

enum class Shutter : std::uint8_t { global, top_to_bottom, left_to_right, bottom_to_top, right_to_left };

struct Lens {
  CameraModel model = CameraModel::pinhole;
  // Project by the unscented transform instead of by the derivative at the centre. The options below need it.
  bool unscented = false;
  // OpenCV's coefficients. Pinhole: (k1 .. k6), (p1, p2), (s1 .. s4). Fisheye: radial (k1 .. k4) alone.
  double radial[6] = {}, tangential[2] = {}, thin_prism[4] = {};
  // Where the distortion stops growing: tangent (pinhole) or angle (fisheye) [rad] from the axis. Beyond, nothing is seen.
  double limit = 1e30;
  double nearest = 0.0;  // [m] a pinhole sees no sigma point nearer than this
  // The sigma points lie `spread` standard deviations from the centre and weigh `weight` each; `excess` is the centre's.
  double spread = 0.0, weight = 0.0, excess = 0.0;
  // Rolling shutter: at time s in -1/2..1/2 the camera has turned by the rotation vector s `turn` (its own axes at s
  // = 0). Its translation has grown by s `step`. View holds the pose at s = 0, whose translation is `pivot`.
  Shutter shutter = Shutter::global;
  double turn[3] = {}, step[3] = {}, pivot[3] = {};
};

}  // namespace splatbot
