// SPDX-License-Identifier: Apache-2.0
#include "scalar_baseline.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "splatbot/kernels.hpp"

namespace splatbot {

namespace {

constexpr int kTile = 16;

struct Splat {
  float x, y, depth;
  float a, b, c;  // inverse covariance: (a b; b c)
  int x0, y0, x1, y1;  // tiles
};

struct Matrix {
  float m[9];
};

Matrix rotation(const float* q) {
  const float norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const float w = q[0] / norm, x = q[1] / norm, y = q[2] / norm, z = q[3] / norm;
  return {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z),
           1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x),
           1 - 2 * (x * x + y * y)}};
}

// The projection of Zwicker et al. 2001; false if the Gaussian is out of view.
bool project(const Gaussians& g, std::size_t i, const View& view, const RasterOptions& options, Splat& s) {
  const float* R = view.rotation;
  const float* mean = g.means.data() + 3 * i;
  float p[3];
  for (int r = 0; r < 3; ++r) {
    p[r] = R[3 * r] * mean[0] + R[3 * r + 1] * mean[1] + R[3 * r + 2] * mean[2] + view.translation[r];
  }
  if (p[2] < options.near_plane || p[2] > options.far_plane) {
    return false;
  }
  const auto width = static_cast<float>(view.width), height = static_cast<float>(view.height);
  const float iz = 1.0F / p[2];
  const float margin_x = 0.5F * kFovMargin * width / view.fx, margin_y = 0.5F * kFovMargin * height / view.fy;
  const float tx = std::clamp(p[0] * iz, -view.cx / view.fx - margin_x, (width - view.cx) / view.fx + margin_x);
  const float ty = std::clamp(p[1] * iz, -view.cy / view.fy - margin_y, (height - view.cy) / view.fy + margin_y);
  const float J[6] = {view.fx * iz, 0.0F, -view.fx * tx * iz, 0.0F, view.fy * iz, -view.fy * ty * iz};
  const Matrix Q = rotation(g.quats.data() + 4 * i);
  float M[6] = {};  // J R Q S
  for (int r = 0; r < 2; ++r) {
    for (int k = 0; k < 3; ++k) {
      float sum = 0.0F;
      for (int j = 0; j < 3; ++j) {
        sum += J[3 * r + j] * (R[3 * j] * Q.m[k] + R[3 * j + 1] * Q.m[3 + k] + R[3 * j + 2] * Q.m[6 + k]);
      }
      M[3 * r + k] = sum * g.scales[3 * i + static_cast<std::size_t>(k)];
    }
  }
  const float cxx = M[0] * M[0] + M[1] * M[1] + M[2] * M[2] + options.eps2d;
  const float cxy = M[0] * M[3] + M[1] * M[4] + M[2] * M[5];
  const float cyy = M[3] * M[3] + M[4] * M[4] + M[5] * M[5] + options.eps2d;
  const float det = cxx * cyy - cxy * cxy;
  if (!(det > 0.0F)) {
    return false;
  }
  s.a = cyy / det;
  s.b = -cxy / det;
  s.c = cxx / det;
  s.x = view.fx * p[0] * iz + view.cx;
  s.y = view.fy * p[1] * iz + view.cy;
  s.depth = p[2];
  const float rx = std::ceil(kMaxSigmas * std::sqrt(cxx)), ry = std::ceil(kMaxSigmas * std::sqrt(cyy));
  const auto tile = [](float v, int most) {
    return static_cast<int>(std::clamp(std::floor(v / kTile), 0.0F, static_cast<float>(most)));
  };
  const int columns = (view.width + kTile - 1) / kTile, rows = (view.height + kTile - 1) / kTile;
  s.x0 = tile(s.x - rx, columns);
  s.x1 = tile(s.x + rx + kTile, columns);
  s.y0 = tile(s.y - ry, rows);
  s.y1 = tile(s.y + ry + kTile, rows);
  return s.x0 < s.x1 && s.y0 < s.y1;
}

struct Falloff {
  float dx, dy, exponential, alpha;
};

Falloff falloff(const Splat& s, float opacity, float px, float py) {
  Falloff f{px - s.x, py - s.y, 0.0F, 0.0F};
  f.exponential = std::exp(-0.5F * (s.a * f.dx * f.dx + s.c * f.dy * f.dy) - s.b * f.dx * f.dy);
  f.alpha = std::min(kAlphaMax, opacity * f.exponential);
  return f;
}

struct Pixel {
  float through = 1.0F;
  std::size_t end = 0;  // of the tile's list, as far as it was walked
};

Pixel blend(const Gaussians& g, const std::vector<Splat>& splats, const std::vector<std::uint32_t>& list, float px,
            float py, float* rgb) {
  Pixel pixel;
  for (pixel.end = 0; pixel.end < list.size(); ++pixel.end) {
    const std::uint32_t id = list[pixel.end];
    const float alpha = falloff(splats[id], g.opacities[id], px, py).alpha;
    if (alpha < kAlphaMin) {
      continue;
    }
    if (pixel.through * (1.0F - alpha) <= kTransmittanceMin) {
      break;
    }
    for (std::size_t c = 0; c < 3; ++c) {
      rgb[c] += alpha * pixel.through * g.colors[3 * id + c];
    }
    pixel.through *= 1.0F - alpha;
  }
  return pixel;
}

// Back to front, with the colour behind divided out of the transmittance, as the original's backward pass does.
void blend_backward(const Gaussians& g, const std::vector<Splat>& splats, const std::vector<std::uint32_t>& list,
                    float px, float py, const Pixel& pixel, const float* grad, const ScalarGradients& out) {
  float through = pixel.through;
  float behind[3] = {};
  for (std::size_t k = pixel.end; k-- > 0;) {
    const std::uint32_t id = list[k];
    const Splat& s = splats[id];
    const Falloff f = falloff(s, g.opacities[id], px, py);
    if (f.alpha < kAlphaMin) {
      continue;
    }
    through /= 1.0F - f.alpha;
    float grad_alpha = 0.0F;
    for (std::size_t c = 0; c < 3; ++c) {
      const float color = g.colors[3 * id + c];
      out.colors[3 * id + c] += f.alpha * through * grad[c];
      grad_alpha += grad[c] * through * (color - behind[c]);
      behind[c] = f.alpha * color + (1.0F - f.alpha) * behind[c];
    }
    if (g.opacities[id] * f.exponential > kAlphaMax) {
      continue;
    }
    out.opacities[id] += f.exponential * grad_alpha;
    const float v = -g.opacities[id] * f.exponential * grad_alpha;  // by the exponent
    out.means2d[2 * id] -= v * (s.a * f.dx + s.b * f.dy);
    out.means2d[2 * id + 1] -= v * (s.b * f.dx + s.c * f.dy);
    out.conics[3 * id] += 0.5F * v * f.dx * f.dx;
    out.conics[3 * id + 1] += v * f.dx * f.dy;
    out.conics[3 * id + 2] += 0.5F * v * f.dy * f.dy;
  }
}

std::vector<std::vector<std::uint32_t>> list_tiles(const std::vector<Splat>& splats, int columns, int rows) {
  std::vector<std::vector<std::uint32_t>> lists(static_cast<std::size_t>(columns) * static_cast<std::size_t>(rows));
  for (std::size_t i = 0; i < splats.size(); ++i) {
    for (int y = splats[i].y0; y < splats[i].y1; ++y) {
      for (int x = splats[i].x0; x < splats[i].x1; ++x) {
        lists[static_cast<std::size_t>(y * columns + x)].push_back(static_cast<std::uint32_t>(i));
      }
    }
  }
  for (std::vector<std::uint32_t>& list : lists) {
    std::stable_sort(list.begin(), list.end(),
                     [&](std::uint32_t i, std::uint32_t j) { return splats[i].depth < splats[j].depth; });
  }
  return lists;
}

}  // namespace

void scalar_baseline(const Gaussians& g, const View& view, const RasterOptions& options, std::span<float> out_colors,
                     std::span<float> out_alphas, std::span<const float> grad_colors,
                     const ScalarGradients& gradients) {
  const std::size_t pixels = static_cast<std::size_t>(view.width) * static_cast<std::size_t>(view.height);
  const bool backward = !grad_colors.empty();
  if (g.channels != 3 || out_colors.size() != 3 * pixels || out_alphas.size() != pixels ||
      (backward && (grad_colors.size() != 3 * pixels || gradients.colors.size() != 3 * g.count ||
                    gradients.opacities.size() != g.count || gradients.means2d.size() != 2 * g.count ||
                    gradients.conics.size() != 3 * g.count))) {
    throw std::invalid_argument("the baseline renders RGB into arrays of the image's and the Gaussians' sizes");
  }
  std::vector<Splat> splats(g.count);
  for (std::size_t i = 0; i < g.count; ++i) {
    if (!project(g, i, view, options, splats[i])) {
      splats[i] = {};
    }
  }
  const int columns = (view.width + kTile - 1) / kTile, rows = (view.height + kTile - 1) / kTile;
  const auto lists = list_tiles(splats, columns, rows);
  std::fill(out_colors.begin(), out_colors.end(), 0.0F);
  for (int y = 0; y < view.height; ++y) {
    for (int x = 0; x < view.width; ++x) {
      const auto& list = lists[static_cast<std::size_t>(y / kTile * columns + x / kTile)];
      const std::size_t i = static_cast<std::size_t>(y) * static_cast<std::size_t>(view.width) + static_cast<std::size_t>(x);
      const float px = static_cast<float>(x) + 0.5F, py = static_cast<float>(y) + 0.5F;
      const Pixel pixel = blend(g, splats, list, px, py, out_colors.data() + 3 * i);
      out_alphas[i] = 1.0F - pixel.through;
      if (backward) {
        blend_backward(g, splats, list, px, py, pixel, grad_colors.data() + 3 * i, gradients);
      }
    }
  }
}

}  // namespace splatbot
