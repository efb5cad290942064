// SPDX-License-Identifier: Apache-2.0
#include "pull_back.hpp"

#include "splatbot/threads.hpp"

namespace splatbot {

void CameraGradient::add_sums(std::span<const double> blocks) {
  for (std::size_t i = 0; i < blocks.size(); ++i) {
    sums[i % kCameraSums] += blocks[i];
  }
}

void add_camera_gradient(const View& view, const CameraGradient& from, std::span<double> out) {
  const auto r = [&](std::size_t i, std::size_t j) { return static_cast<double>(view.rotation[3 * (i % 3) + j % 3]); };
  double determinant = 0.0;
  std::array<double, 3> pulled{};  // R^-T times the gradient to the centre, times det R
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      const double cofactor = r(i + 1, j + 1) * r(i + 2, j + 2) - r(i + 1, j + 2) * r(i + 2, j + 1);
      pulled[i] += cofactor * from.center[j];
      determinant += i == 0 ? cofactor * r(0, j) : 0.0;
    }
  }
  for (std::size_t i = 0; i < kCameraSums; ++i) {
    out[i] += from.sums[i];
  }
  for (std::size_t i = 0; i < 3; ++i) {
    const double shift = -pulled[i] / determinant;
    for (std::size_t j = 0; j < 3; ++j) {
      const double origin = static_cast<double>(view.origin[j]);
      out[3 * i + j] += from.sums[9 + i] * origin + shift * (origin + static_cast<double>(view.center_low[j]));
    }
    out[9 + i] += shift;
  }
}

void add_background_gradient(const TileLists& lists, const View& view, const float* final_state, int planes,
                             std::span<const float> grad_colors, std::span<double> out) {
  const auto width = static_cast<std::size_t>(view.width);
  const auto height = static_cast<std::size_t>(view.height);
  const std::size_t stride = grad_colors.size() / (width * height);
  const std::size_t tile_size = static_cast<std::size_t>(planes) * kTilePixels;
  for (std::size_t y = 0; y < height; ++y) {
    for (std::size_t x = 0; x < width; ++x) {
      const std::size_t tile = y / kTileHeight * static_cast<std::size_t>(lists.columns) + x / kTileWidth;
      const int in_x = static_cast<int>(x % kTileWidth), in_y = static_cast<int>(y % kTileHeight);
      const auto i = static_cast<std::size_t>(pixel_index(in_x, in_y));
      const double t = static_cast<double>(final_state[tile * tile_size + i]);
      for (std::size_t c = 0; c < out.size(); ++c) {
        out[c] += t * static_cast<double>(grad_colors[(y * width + x) * stride + c]);
      }
    }
  }
}

bool wants_harmonics(const Gaussians& g, const Gradients& out) {
  const bool moves = g.sh_degree > 0 && !(out.means.empty() && out.camera.empty());
  return g.sh_degree >= 0 && (moves || !out.colors.empty());
}

void pull_back_harmonics(const HarmonicsArgs& forward, std::size_t blocks, const float* colors, const Gradients& out,
                         Buffer<double>& scratch, CameraGradient& camera) {
  scratch.resize(out.camera.empty() ? 0 : 3 * blocks);
  const HarmonicsBackwardArgs args = {.forward = forward,
                                      .colors = colors,
                                      .accumulate = out.accumulate,
                                      .coefficients = pointer(out.colors),
                                      .means = pointer(out.means),
                                      .center = out.camera.empty() ? nullptr : scratch.data()};
  const Kernels& k = kernels();
  thread_pool()->run(blocks, [&](std::size_t b) { k.harmonics_backward(args, b); });
  for (std::size_t i = 0; i < scratch.size(); ++i) {
    camera.center[i % 3] += scratch[i];
  }
}

}  // namespace splatbot
