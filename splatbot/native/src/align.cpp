// SPDX-License-Identifier: Apache-2.0
#include "splatbot/align.hpp"

#include <cmath>
#include <limits>

namespace splatbot {
namespace {

struct Vec3 {
  double x, y, z;
};

double dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

Vec3 load(std::span<const float> values, std::size_t i) { return {values[3 * i], values[3 * i + 1], values[3 * i + 2]}; }

Vec3 rotate(std::span<const double, 16> T, Vec3 v) {
  return {T[0] * v.x + T[1] * v.y + T[2] * v.z, T[4] * v.x + T[5] * v.y + T[6] * v.z,
          T[8] * v.x + T[9] * v.y + T[10] * v.z};
}

// Value and gradient of the bilinear interpolant, the gradient from central differences one pixel apart.
struct Sample {
  double value, du, dv;
};

Sample sample_gray(const AlignImage& image, double u, double v) {
  const int x = static_cast<int>(u), y = static_cast<int>(v);
  const double a = u - x, b = v - y;
  const float* p = image.gray.data() + static_cast<std::size_t>(y) * image.width + x;
  const int w = image.width;
  const auto bilinear = [&](const float* q) {
    return (1 - b) * ((1 - a) * q[0] + a * q[1]) + b * ((1 - a) * q[w] + a * q[w + 1]);
  };
  return {bilinear(p), 0.5 * (bilinear(p + 1) - bilinear(p - 1)), 0.5 * (bilinear(p + w) - bilinear(p - w))};
}

// Depth between pixels, refused where the four neighbours are not one surface.
double sample_depth(const AlignImage& image, double u, double v) {
  const int x = static_cast<int>(u), y = static_cast<int>(v);
  const double a = u - x, b = v - y;
  const float* q = image.depth.data() + static_cast<std::size_t>(y) * image.width + x;
  const float d0 = q[0], d1 = q[1], d2 = q[image.width], d3 = q[image.width + 1];
  const float low = std::fmin(std::fmin(d0, d1), std::fmin(d2, d3));
  const float high = std::fmax(std::fmax(d0, d1), std::fmax(d2, d3));
  if (!(low > 0.0f) || high - low > 0.05f * low) return 0.0;
  return (1 - b) * ((1 - a) * d0 + a * d1) + b * ((1 - a) * d2 + a * d3);
}

// Adds one residual with its Jacobian over the first `n` states.
void accumulate(AlignSums& sums, const double* J, int n, double r, double sigma, double nu) {
  const double s = r / sigma;
  const double w = (nu + 1.0) / (nu + s * s) / (sigma * sigma);
  for (int i = 0; i < n; ++i) {
    for (int j = i; j < n; ++j) sums.H[8 * i + j] += w * J[i] * J[j];
    sums.g[i] += w * J[i] * r;
  }
  sums.cost += 0.5 * (nu + 1.0) * std::log1p(s * s / nu);
}

}  // namespace

AlignSums linearize_alignment(const AlignImage& image, const AlignPoints& reference,
                              std::span<const double, 16> T, double gain, double offset,
                              const AlignSettings& settings, std::span<float> residual_photometric,
                              std::span<float> residual_geometric) {
  AlignSums sums;
  const std::size_t n = reference.gray.size();
  const float nan = std::numeric_limits<float>::quiet_NaN();
  for (std::size_t i = 0; i < n; ++i) {
    residual_photometric[i] = residual_geometric[i] = nan;
    const Vec3 p = load(reference.points, i);
    Vec3 q = rotate(T, p);
    q = {q.x + T[3], q.y + T[7], q.z + T[11]};
    if (!(q.z > 1e-3)) continue;
    const double iz = 1.0 / q.z;
    const double u = image.fx * q.x * iz + image.cx, v = image.fy * q.y * iz + image.cy;
    // The gradient reads one pixel further on each side. Written so that NaN fails.
    if (!(u >= 1.0 && v >= 1.0 && u < image.width - 2 && v < image.height - 2)) continue;
    ++sums.projected;
    const double depth = sample_depth(image, u, v);
    const double sigma_z = settings.sigma_depth_floor + settings.sigma_depth_quad * q.z * q.z;
    // A point far behind or before what the camera sees is occluded or gone: its colour tells nothing either.
    if (depth > 0.0 && std::abs(depth - q.z) > settings.gate + 3.0 * sigma_z) continue;

    if (settings.use_photometric) {
      const Sample s = sample_gray(image, u, v);
      const double r = s.value - (gain * reference.gray[i] + offset);
      const double gx = s.du * image.fx * iz, gy = s.dv * image.fy * iz, gz = -(gx * q.x + gy * q.y) * iz;
      const double J[8] = {gx, gy, gz, gz * q.y - gy * q.z, gx * q.z - gz * q.x, gy * q.x - gx * q.y,
                           -reference.gray[i], -1.0};
      accumulate(sums, J, 8, r, settings.sigma_gray, settings.nu);
      residual_photometric[i] = static_cast<float>(r / settings.sigma_gray);
      ++sums.photometric;
    }
    const Vec3 normal = rotate(T, load(reference.normals, i));
    if (settings.use_geometric && depth > 0.0 && dot(normal, normal) > 0.25) {
      // Point to plane: n · (P - q) with P the observed point on the same ray, P = q · depth / q.z.
      const double n_q = dot(normal, q);
      const double r = n_q * (depth * iz - 1.0);
      const double cosine = std::abs(n_q) / std::sqrt(dot(q, q));
      const double sigma = settings.sigma_depth_floor + sigma_z * cosine;
      const double J[6] = {-normal.x, -normal.y, -normal.z, normal.y * q.z - normal.z * q.y,
                           normal.z * q.x - normal.x * q.z, normal.x * q.y - normal.y * q.x};
      accumulate(sums, J, 6, r, sigma, settings.nu);
      residual_geometric[i] = static_cast<float>(r / sigma);
      ++sums.geometric;
    }
  }
  for (int i = 0; i < 8; ++i)
    for (int j = 0; j < i; ++j) sums.H[8 * i + j] = sums.H[8 * j + i];
  return sums;
}

}  // namespace splatbot
