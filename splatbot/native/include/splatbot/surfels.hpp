// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <optional>
#include <span>

#include "splatbot/rasterizer.hpp"

namespace splatbot {

// Colours that one surfel render takes; more are rendered by several.
inline constexpr int kMaxSurfelChannels = 8;

struct SurfelOptions {
  float near_plane = 0.01F;
  float far_plane = 1e10F;
  float radius_clip = 0.0F;  // [px]; smaller surfels are left out
  DepthMode depth = DepthMode::none;
  bool distortion = false;
};

// Outputs of a surfel render. `median` and `distortion` are (H, W), the latter empty if not requested.
struct SurfelImages {
  std::span<float> colors;   // (H, W, channels [+ 1 for a requested depth, last])
  std::span<float> alphas;   // (H, W)
  std::span<float> normals;  // (H, W, 3), world frame
  std::span<float> median;
  std::span<float> distortion;
};

struct SurfelState;
using SurfelStatePtr = std::shared_ptr<SurfelState>;

// Renders flat Gaussians (Huang et al. 2024, 2D Gaussian Splatting): discs in the plane of the first two axes, met by
// each pixel's ray. The third scale is ignored. A disc's response is exp(-(u^2 + v^2) / 2) at the hit, in standard
// deviations. If it is larger, exp(-d^2) counts instead, d pixels from the projected centre. Depth is that of the
// hit, or of the centre if the second response counts. Hits nearer than the near plane are ignored. Blending is that
// of rasterize_forward().
std::optional<Fault> surfels_forward(const Gaussians& surfels, const View& view, const SurfelOptions& options,
                                     std::span<const float> background, const SurfelImages& out,
                                     SurfelStatePtr& state);

// Gradients of a loss to the images; an empty span is zero.
struct SurfelImageGradients {
  std::span<const float> colors, alphas, normals, median, distortion;
};

// As rasterize_backward(); absolute2d is not computed.
void surfels_backward(const SurfelState& state, const Gaussians& surfels, std::span<const float> background,
                      const SurfelImageGradients& grads, const Gradients& out);

// Results of projection, one row a surfel; rows of surfels out of view are zero.
struct SurfelProjections {
  std::span<float> means2d;               // (N, 2) [px]
  std::span<float> depths;                // (N,)
  std::span<float> normals;               // (N, 3) world frame, facing the camera
  std::span<std::int32_t> radii;          // (N, 2) [px]
  std::span<std::int32_t> tiles_touched;  // (N,)
};
void describe_surfels(const SurfelState& state, const SurfelProjections& out);

std::size_t surfel_count(const SurfelState& state);

std::span<const std::uint32_t> visible_ids(const SurfelState& state);
TileInfo tile_info(const SurfelState& state);

}  // namespace splatbot
