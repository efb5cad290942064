// SPDX-License-Identifier: Apache-2.0
// Comparison of points with the depth that an image measures at their pixels.
#pragma once

#include <cstdint>
#include <span>

#include "splatbot/depth.hpp"

namespace splatbot {

// A measured depth m agrees with a point at depth z if |m - z| <= agreement(z). Its ray passes the point if
// m - z > passage(z). Both are constant + quadratic * z^2 [m].
struct DepthTolerance {
  double constant = 0.0, quadratic = 0.0;  // [m], [1/m]
  double at(double z) const { return constant + quadratic * z * z; }
};

// Adds one view to the counts (P, 3) of points (P, 3) [m, world]. They are the views that agree with the point, that
// pass it, and that have depth at its pixel. T_camera_world is (4, 4) by rows. Points whose owner (P,) is `view` are
// left out.
void count_measurements(const DepthImage& depth, const Pinhole& camera, std::span<const double, 16> T_camera_world,
                        std::span<const double> points, std::span<const std::int32_t> owners, std::int32_t view,
                        const DepthTolerance& agreement, const DepthTolerance& passage,
                        std::span<std::int32_t> counts);

}  // namespace splatbot
