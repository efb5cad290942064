// SPDX-License-Identifier: Apache-2.0
#include "splatbot/rectify.hpp"

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstddef>

#include "splatbot/se3.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {
namespace {

using Eigen::Vector3d;

// Each iteration leaves the share of the error by which the displacement changes from row to row: 7 % for 30 ms at
// 120 °/s. The first one begins with the displacement of the neighbour, so that most pixels need one or two.
constexpr int kIterations = 4;
constexpr double kConverged = 0.02;  // [px]
constexpr double kOneSurface = 0.02;  // share of its depth by which neighbours on one surface differ at most
constexpr double kFar = 1e3;          // [m] depth of a pixel of which nothing is known
constexpr std::size_t kRowsPerTask = 16;

class Motion {
 public:
  Motion(const RowMotion& motion, int height)
      : v_(motion.twist[0], motion.twist[1], motion.twist[2]),
        w_(motion.twist[3], motion.twist[4], motion.twist[5]),
        per_row_(height > 1 ? motion.readout / (height - 1) : 0.0),
        first_(motion.delay - 0.5 * per_row_ * (height - 1)) {}

  // Time [s] of a row after the stamp.
  double time_of(double row) const { return first_ + per_row_ * row; }

  // exp(s ξ) X to the third order in s. At 10 rad/s and s = 15 ms the fourth order is 2e-5 of X.
  Vector3d move(const Vector3d& X, double s) const {
    const Vector3d a = v_ + w_.cross(X);
    const Vector3d b = w_.cross(a);
    return X + s * (a + s / 2.0 * (b + s / 3.0 * w_.cross(b)));
  }

 private:
  Vector3d v_, w_;
  double per_row_, first_;
};

struct Pixel {
  double u, v;
};

Vector3d backproject(const Pinhole& c, Pixel p, double z) { return {z * (p.u - c.cx) / c.fx, z * (p.v - c.cy) / c.fy, z}; }

Pixel project(const Pinhole& c, const Vector3d& X) {
  const double z = std::max(X.z(), 1e-3);  // points behind the camera leave the image
  return {c.fx * X.x() / z + c.cx, c.fy * X.y() / z + c.cy};
}

double nearest(const DepthImage& image, Pixel p) {
  if (!(p.u > -0.5 && p.v > -0.5 && p.u < image.width - 0.5 && p.v < image.height - 0.5)) return 0.0;
  const auto column = static_cast<std::size_t>(p.u + 0.5), row = static_cast<std::size_t>(p.v + 0.5);
  return image.z[row * image.width + column];
}

// Depth between pixels: linear on one surface, that of the nearest pixel at an edge, 0 where that is missing.
double interpolated(const DepthImage& image, Pixel p) {
  const double near = nearest(image, p);
  if (!(near > 0.0) || !(p.u >= 0.0 && p.v >= 0.0 && p.u < image.width - 1 && p.v < image.height - 1)) return near;
  const auto column = static_cast<std::size_t>(p.u), row = static_cast<std::size_t>(p.v);
  const double a = p.u - static_cast<double>(column), b = p.v - static_cast<double>(row);
  const float* z = image.z.data() + row * image.width + column;
  const double d0 = z[0], d1 = z[1], d2 = z[image.width], d3 = z[image.width + 1];
  const double low = std::min({d0, d1, d2, d3}), high = std::max({d0, d1, d2, d3});
  if (!(low > 0.0) || high - low > kOneSurface * near) return near;
  return (1 - b) * ((1 - a) * d0 + a * d1) + b * ((1 - a) * d2 + a * d3);
}

template <class Task>
void for_rows(int height, Task&& task) {
  const std::size_t rows = static_cast<std::size_t>(height);
  thread_pool()->run((rows + kRowsPerTask - 1) / kRowsPerTask, [&](std::size_t block) {
    for (std::size_t v = block * kRowsPerTask; v < std::min(rows, (block + 1) * kRowsPerTask); ++v) task(static_cast<int>(v));
  });
}

}  // namespace

void rectify_depth(const DepthImage& depth, const Pinhole& camera, const RowMotion& motion,
                   std::span<const double, 16> T_color_depth, std::span<float> out) {
  const Motion during(motion, depth.height);
  const Pose T = pose_from(T_color_depth);
  const auto at_stamp = [&](Pixel from, double z) {
    return during.move(T * backproject(camera, from, z), during.time_of(from.v));
  };
  for_rows(depth.height, [&](int v) {
    float* row = out.data() + static_cast<std::size_t>(v) * depth.width;
    double known = kFar;              // depth of the last pixel in this row that has one
    Pixel shift{0.0, 0.0};            // from the pixel at the stamp to the one measured: nearly that of the neighbour
    for (int u = 0; u < depth.width; ++u) {
      const Pixel to{static_cast<double>(u), static_cast<double>(v)};
      Pixel from{to.u + shift.u, to.v + shift.v}, error{0.0, 0.0};
      for (int k = 0; k < kIterations; ++k) {
        const double z = nearest(depth, from);
        if (z > 0.0) known = z;
        const Pixel seen = project(camera, at_stamp(from, known));
        error = {seen.u - to.u, seen.v - to.v};
        if (std::abs(error.u) + std::abs(error.v) < kConverged) break;
        from = {from.u - error.u, from.v - error.v};
      }
      shift = {from.u - to.u, from.v - to.v};
      const double z = interpolated(depth, from);
      const bool found = z > 0.0 && std::hypot(error.u, error.v) < kRectifyTolerance;
      row[u] = found ? static_cast<float>(std::max(at_stamp(from, z).z(), 0.0)) : 0.0F;
    }
  });
}

void rectify_map(const DepthImage& depth, const Pinhole& camera, const RowMotion& motion, std::span<float> out) {
  const Motion during(motion, depth.height);
  for_rows(depth.height, [&](int v) {
    const float* row = depth.z.data() + static_cast<std::size_t>(v) * depth.width;
    float* to = out.data() + 2 * static_cast<std::size_t>(v) * depth.width;
    double known = kFar, shift = 0.0;  // shift: [px] of rows, nearly that of the neighbour
    for (int u = 0; u < depth.width; ++u) {
      if (row[u] > 0.0F) known = row[u];
      const Vector3d X = backproject(camera, {static_cast<double>(u), static_cast<double>(v)}, known);
      Pixel from{0.0, v + shift};
      for (int k = 0; k < kIterations; ++k) {
        const double before = std::clamp(from.v, -static_cast<double>(depth.height), 2.0 * depth.height);
        from = project(camera, during.move(X, -during.time_of(before)));
        if (std::abs(from.v - before) < kConverged) break;  // u follows from v
      }
      shift = std::clamp(from.v - v, -static_cast<double>(depth.height), static_cast<double>(depth.height));
      to[2 * u] = static_cast<float>(from.u);
      to[2 * u + 1] = static_cast<float>(from.v);
    }
  });
}

}  // namespace splatbot
