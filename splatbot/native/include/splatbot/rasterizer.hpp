// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string_view>

#include "splatbot/lens.hpp"

namespace splatbot {

// N Gaussians in the world frame. Contiguous rows; colours have `channels` columns.
struct Gaussians {
  std::size_t count = 0;
  int channels = 0;
  std::span<const float> means;      // (N, 3)
  std::span<const float> quats;      // (N, 4) wxyz, any norm; a zero quaternion counts as no rotation
  std::span<const float> scales;     // (N, 3)
  std::span<const float> opacities;  // (N,)
  std::span<const float> colors;     // (N, channels)
};

// A camera, a pinhole unless its lens says otherwise; pixel (i, j) covers [i, i+1) x [j, j+1), its centre is at +0.5.
struct View {
  float rotation[9];  // world to camera, row-major
  float translation[3];
  float fx, fy, cx, cy;  // [px]
  int width, height;     // [px]
  Lens lens{};
};

enum class DepthMode : std::uint8_t {
  none,
  accumulated,  // sum of weight x depth
  expected,     // that, divided by the sum of weights
};

struct RasterOptions {
  float near_plane = 0.01F;
  float far_plane = 1e10F;
  float radius_clip = 0.0F;  // [px]; smaller Gaussians are left out
  float eps2d = 0.3F;        // [px^2]; added to the diagonal of the projected covariance
  DepthMode depth = DepthMode::none;
  bool plane_depth = false;  // depth varies over a footprint as that of the Gaussian's own plane
};

// An input value that is not finite.
struct Fault {
  std::string_view field;
  std::size_t row;
};

// What a forward pass leaves for its backward pass. Opaque; see raster_state.hpp.
struct RasterState;
using RasterStatePtr = std::shared_ptr<RasterState>;

// Renders colours (H, W, channels [+ 1 when depth is asked for, last]) and alphas (H, W).
//
// The model is that of 3D Gaussian splatting (Kerbl 2023, Zwicker 2001) with gsplat's constants: a Gaussian counts in a
// pixel from alpha = 1/255 on, alpha is capped at 0.99, and a pixel is closed by the Gaussian that would bring its
// transmittance to 1e-4 or below, which is left out. Order is by depth, equal depths by index. The result depends
// neither on the number of threads nor on earlier calls. `background` (channels,) may be empty.
//
// Returns the fault instead of rendering if an input is not finite.
std::optional<Fault> rasterize_forward(const Gaussians& gaussians, const View& view, const RasterOptions& options,
                                       std::span<const float> background, std::span<float> out_colors,
                                       std::span<float> out_alphas, RasterStatePtr& state);

// Where gradients go; an empty span is not computed. With `accumulate`, they are added to what is there.
struct Gradients {
  std::span<float> means, quats, scales, opacities, colors;
  std::span<double> viewmat;     // (12,): dL/d(rotation row-major, translation)
  std::span<double> background;  // (channels,)
  bool accumulate = false;
};

// The gradient of a loss from its gradients to the rendered colours and alphas (an empty span is zero). The Gaussians,
// view, options and background are those of the forward pass.
void rasterize_backward(const RasterState& state, const Gaussians& gaussians, std::span<const float> background,
                        std::span<const float> grad_colors, std::span<const float> grad_alphas, const Gradients& out);

// What projection found, one row a Gaussian; rows of Gaussians out of view are zero.
struct Projections {
  std::span<float> means2d;               // (N, 2) [px]
  std::span<float> depths;                // (N,)
  std::span<float> conics;                // (N, 3): the inverse of the 2D covariance, upper triangle [px^-2]
  std::span<std::int32_t> radii;          // (N, 2) [px]
  std::span<std::int32_t> tiles_touched;  // (N,)
};
void describe_projections(const RasterState& state, std::span<const float> opacities, const Projections& out);

// Indices of the Gaussians in view, ascending.
std::span<const std::uint32_t> visible_ids(const RasterState& state);

struct TileInfo {
  int tile_width, tile_height;  // [px]
  int columns, rows;
  std::size_t pairs;        // (Gaussian, tile) pairs
  std::size_t state_bytes;  // memory held
};
TileInfo tile_info(const RasterState& state);

}  // namespace splatbot
