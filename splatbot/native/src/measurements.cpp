// SPDX-License-Identifier: Apache-2.0
#include "splatbot/measurements.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>

#include "splatbot/threads.hpp"

namespace splatbot {
namespace {

constexpr std::size_t kBlock = 1 << 14;  // points of a task
constexpr double kNearest = 0.05;        // [m] depth from which a point projects

}  // namespace

void count_measurements(const DepthImage& depth, const Pinhole& camera, std::span<const double, 16> T_camera_world,
                        std::span<const double> points, std::span<const std::int32_t> owners, std::int32_t view,
                        const DepthTolerance& agreement, const DepthTolerance& passage,
                        std::span<std::int32_t> counts) {
  const std::size_t count = owners.size();
  const auto row = [&T = T_camera_world](std::size_t i, const double* p) {
    return T[4 * i] * p[0] + T[4 * i + 1] * p[1] + T[4 * i + 2] * p[2] + T[4 * i + 3];
  };
  thread_pool()->run((count + kBlock - 1) / kBlock, [&](std::size_t block) {
    for (std::size_t i = block * kBlock; i < std::min(count, (block + 1) * kBlock); ++i) {
      if (owners[i] == view) continue;
      const double* p = points.data() + 3 * i;
      const double z = row(2, p);
      if (!(z > kNearest)) continue;
      const double u = std::nearbyint(camera.fx * row(0, p) / z + camera.cx);
      const double v = std::nearbyint(camera.fy * row(1, p) / z + camera.cy);
      if (!(u >= 0.0 && u < depth.width && v >= 0.0 && v < depth.height)) continue;
      const float measured = depth.z[static_cast<std::size_t>(v) * static_cast<std::size_t>(depth.width) +
                                     static_cast<std::size_t>(u)];
      if (!(measured > 0.0F && measured < std::numeric_limits<float>::infinity())) continue;
      const double behind = static_cast<double>(measured) - z;
      std::int32_t* of_point = counts.data() + 3 * i;
      of_point[0] += std::abs(behind) <= agreement.at(z);
      of_point[1] += behind > passage.at(z);
      ++of_point[2];
    }
  });
}

}  // namespace splatbot
