// SPDX-License-Identifier: Apache-2.0
#include "splatbot/depth.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

namespace splatbot {
namespace {

constexpr double kOneSurface = 0.05;  // share of its depth by which a pixel differs from those of its surface at most

// Values of an image's pixels inside a border of zeros: a pixel at the rim has neighbours there, which say nothing.
class Bordered {
 public:
  template <typename ValueOf>
  Bordered(const DepthImage& depth, ValueOf value_of)
      : stride_(static_cast<std::size_t>(depth.width) + 2),
        values_(stride_ * (static_cast<std::size_t>(depth.height) + 2), 0.0F) {
    for (int v = 0; v < depth.height; ++v) {
      const float* from = depth.z.data() + static_cast<std::size_t>(v) * depth.width;
      float* to = values_.data() + offset(v);
      for (int u = 0; u < depth.width; ++u) to[u] = value_of(from[u]);
    }
  }

  // Row v of the image; those above and below it are `stride` away.
  const float* row(int v) const { return values_.data() + offset(v); }
  std::size_t stride() const { return stride_; }

 private:
  std::size_t offset(int v) const { return (static_cast<std::size_t>(v) + 1) * stride_ + 1; }

  std::size_t stride_;
  std::vector<float> values_;
};

}  // namespace

void valid_depth(const DepthImage& depth, float near, float far, float step, std::span<float> out) {
  const int width = depth.width, height = depth.height;
  const Bordered within(depth, [near, far](float z) { return z >= near && z <= far ? z : 0.0F; });  // 0 for NaN
  for (int v = 0; v < height; ++v) {
    const float* row = within.row(v);
    const float *above = row - within.stride(), *below = row + within.stride();
    float* to = out.data() + static_cast<std::size_t>(v) * width;
    for (int u = 0; u < width; ++u) {
      const float z = row[u], jump = step * z;
      const auto flies = [z, jump](float a, float b) {
        const bool rises = (z - a > jump) & (b - z > jump) & (a > 0.0F);
        const bool falls = (a - z > jump) & (z - b > jump) & (b > 0.0F);
        return rises | falls;
      };
      to[u] = flies(row[u - 1], row[u + 1]) | flies(above[u], below[u]) ? 0.0F : z;
    }
  }
}

void halve_depth(const DepthImage& depth, std::span<float> out) {
  constexpr float kAsFar = static_cast<float>(1.0 + kOneSurface);
  const int width = depth.width / 2, height = depth.height / 2;
  for (int v = 0; v < height; ++v) {
    const float* upper = depth.z.data() + static_cast<std::size_t>(2 * v) * depth.width;
    const float* lower = upper + depth.width;
    float* to = out.data() + static_cast<std::size_t>(v) * width;
    for (int u = 0; u < width; ++u) {
      const std::array<float, 4> z = {upper[2 * u], upper[2 * u + 1], lower[2 * u], lower[2 * u + 1]};
      float nearest = std::numeric_limits<float>::infinity();
      for (const float d : z) nearest = d > 0.0F ? std::min(nearest, d) : nearest;
      float sum = 0.0F, count = 0.0F;
      for (const float d : z) {
        const bool same = d > 0.0F && d <= kAsFar * nearest;
        sum += same ? d : 0.0F;
        count += same ? 1.0F : 0.0F;
      }
      to[u] = sum / std::max(count, 1.0F);
    }
  }
}

void depth_around(const DepthImage& depth, std::span<const float> pixels, std::span<double> out) {
  for (std::size_t i = 0; i < out.size(); ++i) {
    const int u = std::clamp(static_cast<int>(std::nearbyint(pixels[2 * i])), 0, depth.width - 1);
    const int v = std::clamp(static_cast<int>(std::nearbyint(pixels[2 * i + 1])), 0, depth.height - 1);
    std::array<float, 25> window;
    std::size_t n = 0;
    for (int y = std::max(v - 2, 0); y <= std::min(v + 2, depth.height - 1); ++y) {
      for (int x = std::max(u - 2, 0); x <= std::min(u + 2, depth.width - 1); ++x) {
        const float z = depth.z[static_cast<std::size_t>(y) * depth.width + x];
        if (z > 0.0F) window[n++] = z;
      }
    }
    std::sort(window.begin(), window.begin() + n);
    const double median = n == 0 ? 0.0 : 0.5 * (static_cast<double>(window[(n - 1) / 2]) + window[n / 2]);
    const bool one = n > 0 && static_cast<double>(window[n - 1]) - window[0] <= kOneSurface * median;
    out[i] = one ? median : std::numeric_limits<double>::quiet_NaN();
  }
}

void gray_of_one_surface(const DepthImage& depth, std::span<const float> gray, float step, float floor, float quad,
                         std::span<float> out) {
  const int width = depth.width, height = depth.height;
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
  const Bordered inverse(depth, [](float z) { return (z > 0.0F ? 1.0F : 0.0F) / (z > 0.0F ? z : 1.0F); });
  for (int v = 0; v < height; ++v) {
    const std::size_t at = static_cast<std::size_t>(v) * width;
    const float *z = depth.z.data() + at, *g = gray.data() + at;
    const float* row = inverse.row(v);
    const float *above = row - inverse.stride(), *below = row + inverse.stride();
    float* to = out.data() + at;
    for (int u = 0; u < width; ++u) {
      const float w = row[u], kept = g[u], apart = step * z[u], noise = floor + quad * z[u] * z[u];
      const float limit = (apart > noise ? apart : noise) / (z[u] * z[u]);
      const auto bend = [w](float a, float b) {
        const float bent = std::abs(a + b - 2.0F * w);
        return (a > 0.0F) & (b > 0.0F) ? bent : 0.0F;
      };
      const auto larger = [](float a, float b) { return a > b ? a : b; };
      const float most = larger(larger(bend(row[u - 1], row[u + 1]), bend(above[u], below[u])),
                                larger(bend(above[u - 1], below[u + 1]), bend(above[u + 1], below[u - 1])));
      to[u] = (most > limit) & (w > 0.0F) ? kNaN : kept;
    }
  }
}

void smooth_depth(const DepthImage& depth, float step, float floor, float quad, std::span<float> out) {
  const int width = depth.width, height = depth.height;
  const Bordered measured(depth, [](float z) { return z > 0.0F ? z : 0.0F; });  // 0 for NaN
  for (int v = 0; v < height; ++v) {
    const float* row = measured.row(v);
    const float *above = row - measured.stride(), *below = row + measured.stride();
    float* to = out.data() + static_cast<std::size_t>(v) * width;
    for (int u = 0; u < width; ++u) {
      const float z = row[u], apart = step * z, noise = floor + quad * z * z;
      float sum = z, count = 1.0F;
      const auto add = [&, z, apart, noise](float a, float b) {
        const bool same = (a > 0.0F) & (b > 0.0F) & (std::abs(a - b) < apart) & (std::abs(0.5F * (a + b) - z) < noise);
        sum += same ? a + b : 0.0F;
        count += same ? 2.0F : 0.0F;
      };
      add(row[u - 1], row[u + 1]);
      add(above[u], below[u]);
      add(above[u - 1], below[u + 1]);
      add(above[u + 1], below[u - 1]);
      to[u] = z > 0.0F ? sum / count : 0.0F;
    }
  }
}

void normals_of(const DepthImage& depth, const Pinhole& camera, std::span<float> out) {
  constexpr float kApart = static_cast<float>(kOneSurface);
  const int width = depth.width, height = depth.height;
  std::fill(out.begin(), out.end(), 0.0F);
  if (width < 3 || height < 3) return;
  std::vector<float> x(static_cast<std::size_t>(width)), y(static_cast<std::size_t>(height));
  for (int u = 0; u < width; ++u) x[u] = static_cast<float>((u - camera.cx) / camera.fx);
  for (int v = 0; v < height; ++v) y[v] = static_cast<float>((v - camera.cy) / camera.fy);
  for (int v = 1; v + 1 < height; ++v) {
    const float* row = depth.z.data() + static_cast<std::size_t>(v) * width;
    const float *above = row - width, *below = row + width;
    float* to = out.data() + 3 * static_cast<std::size_t>(v) * width;
    for (int u = 1; u + 1 < width; ++u) {
      const float z = row[u], left = row[u - 1], right = row[u + 1], up = above[u], down = below[u];
      const float apart = std::max(std::max(std::abs(left - z), std::abs(right - z)),
                                   std::max(std::abs(up - z), std::abs(down - z)));
      const bool whole = (z > 0.0F) & (left > 0.0F) & (right > 0.0F) & (up > 0.0F) & (down > 0.0F);
      if (!(whole & (apart < kApart * z))) continue;
      const float ux = right * x[u + 1] - left * x[u - 1], uy = right * y[v] - left * y[v], uz = right - left;
      const float vx = down * x[u] - up * x[u], vy = down * y[v + 1] - up * y[v - 1], vz = down - up;
      const float nx = vy * uz - vz * uy, ny = vz * ux - vx * uz, nz = vx * uy - vy * ux;
      const float length = std::sqrt(nx * nx + ny * ny + nz * nz);
      if (!(length > 0.0F)) continue;
      to[3 * u] = nx / length;
      to[3 * u + 1] = ny / length;
      to[3 * u + 2] = nz / length;
    }
  }
}

}  // namespace splatbot
