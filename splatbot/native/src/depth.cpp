// SPDX-License-Identifier: Apache-2.0
#include "splatbot/depth.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

namespace splatbot {

void valid_depth(const DepthImage& depth, float near, float far, float step, std::span<float> out) {
  const int width = depth.width, height = depth.height;
  // Two rows of zeros and a column on each side: a pixel of the border has no neighbour there, which speaks for it.
  const std::size_t stride = static_cast<std::size_t>(width) + 2;
  std::vector<float> padded(stride * (static_cast<std::size_t>(height) + 2), 0.0F);
  for (int v = 0; v < height; ++v) {
    const float* from = depth.z.data() + static_cast<std::size_t>(v) * width;
    float* to = padded.data() + (static_cast<std::size_t>(v) + 1) * stride + 1;
    for (int u = 0; u < width; ++u) to[u] = from[u] >= near && from[u] <= far ? from[u] : 0.0F;  // false for NaN
  }
  for (int v = 0; v < height; ++v) {
    const float* row = padded.data() + (static_cast<std::size_t>(v) + 1) * stride + 1;
    const float *above = row - stride, *below = row + stride;
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
        const bool same = d > 0.0F && d <= 1.05F * nearest;
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
    const bool one = n > 0 && static_cast<double>(window[n - 1]) - window[0] <= 0.05 * median;
    out[i] = one ? median : std::numeric_limits<double>::quiet_NaN();
  }
}

void gray_of_one_surface(const DepthImage& depth, std::span<const float> gray, float step, float floor, float quad,
                         std::span<float> out) {
  const int width = depth.width, height = depth.height;
  constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
  std::vector<float> inverse(depth.z.size());  // 0 where nothing is measured
  for (std::size_t i = 0; i < inverse.size(); ++i) inverse[i] = depth.z[i] > 0.0F ? 1.0F / depth.z[i] : 0.0F;
  std::copy(gray.begin(), gray.end(), out.begin());
  const auto bends = [](const float* w, std::ptrdiff_t to, float limit) {
    const float a = w[-to], b = w[to];
    return (a > 0.0F) & (b > 0.0F) & (std::abs(a + b - 2.0F * w[0]) > limit);
  };
  for (int v = 0; v < height; ++v) {
    const std::size_t at = static_cast<std::size_t>(v) * width;
    const bool between = v > 0 && v + 1 < height;
    for (int u = 0; u < width; ++u) {
      const float* w = inverse.data() + at + u;
      if (w[0] <= 0.0F) continue;
      const float z = depth.z[at + u];
      const float limit = std::max(step * z, floor + quad * z * z) / (z * z);
      const bool beside = u > 0 && u + 1 < width;
      bool edge = beside && bends(w, 1, limit);
      if (between) {
        edge |= bends(w, width, limit);
        if (beside) edge |= bends(w, width + 1, limit) | bends(w, width - 1, limit);
      }
      if (edge) out[at + u] = kNaN;
    }
  }
}

}  // namespace splatbot
