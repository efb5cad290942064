// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string_view>
#include <vector>

#include "splatbot/lens.hpp"

namespace splatbot {

inline constexpr int kMaxHarmonicsDegree = 4;

// N Gaussians in the world frame. Contiguous rows; colours have `channels` columns, or are harmonics.
struct Gaussians {
  std::size_t count = 0;
  int channels = 0;
  std::span<const float> means;      // (N, 3)
  std::span<const float> quats;      // (N, 4) wxyz, any norm; a zero quaternion counts as no rotation
  std::span<const float> scales;     // (N, 3)
  std::span<const float> covars;     // (N, 3, 3), or empty: in place of quats and scales; the upper triangle counts
  std::span<const float> opacities;  // (N,)
  std::span<const float> colors;     // (N, channels), or (N, coefficients, 3) with harmonics
  int sh_degree = -1;                // of the harmonics in use, -1 for plain colours; with it, channels is 3
  int coefficients = 0;              // harmonics held: at least (sh_degree + 1)^2
};

// A camera, a pinhole unless its lens says otherwise; pixel (i, j) covers [i, i+1) x [j, j+1), its centre is at +0.5.
// A world point x is at rotation (x - origin) + translation: with the origin at the camera, nothing is lost far from the world's origin.
struct View {
  float rotation[9];  // world to camera, row-major
  float translation[3];
  float origin[3];
  float center_low[3];   // the camera's centre less origin: the rounding error of the origin
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
  bool antialiased = false;  // opacity falls by the ratio in which the blur enlarges a footprint's area
  float transmittance_min = 1e-4F;  // a pixel is closed before its transmittance falls to this
};

// Pixels to leave out, by square tiles of `size` pixels, row by row; nonzero counts. Empty: none.
struct TileMask {
  std::span<const std::uint8_t> keep;
  int size = 16;
};

// An input value that is not finite.
struct Fault {
  std::string_view field;
  std::size_t row;
};

// State that a forward pass leaves for its backward pass. Opaque; see raster_state.hpp.
struct RasterState;
using RasterStatePtr = std::shared_ptr<RasterState>;

// Renders colours (H, W, channels [+ 1 for a requested depth, last]) and alphas (H, W).
//
// The model is that of 3D Gaussian splatting (Kerbl 2023, Zwicker 2001) with gsplat's constants. A Gaussian
// contributes to a pixel from alpha = 1/255 on, and alpha is capped at 0.99. The Gaussian that would bring the
// transmittance to 1e-4 or below closes the pixel and is left out. Order is by depth, equal depths by index. The
// result depends neither on the number of threads nor on earlier calls. `background` (channels,) may be empty.
//
// Returns the fault instead of rendering if an input is not finite.
std::optional<Fault> rasterize_forward(const Gaussians& gaussians, const View& view, const RasterOptions& options,
                                       std::span<const float> background, const TileMask& mask,
                                       std::span<float> out_colors, std::span<float> out_alphas,
                                       RasterStatePtr& state);

// The Gaussians that the view may see: those that rasterize_forward() would blend, hidden ones included. Their indices,
// ascending, or the fault. Renders nothing; colours are not looked at.
std::optional<Fault> find_visible(const Gaussians& gaussians, const View& view, const RasterOptions& options,
                                  std::vector<std::uint32_t>& ids);

// Sums over Gaussians for a camera's gradient: rotation, translation, fx, fy, cx, cy. Those of a rolling shutter's
// turn, step and pivot follow (see Lens), 0 for others.
inline constexpr int kMotionSums = 9;
inline constexpr int kCameraSums = 16 + kMotionSums;

// Destinations of gradients; an empty span is not computed. With `accumulate`, they are added to the present values.
struct Gradients {
  std::span<float> means, quats, scales, covars, opacities, colors;
  std::span<double> camera;      // (kCameraSums,): dL/d(world-to-camera rotation row-major, translation, fx, fy, cx, cy, ...)
  std::span<double> background;  // (channels,)
  std::span<float> means2d;      // (N, 2): to the projected centres; never accumulated
  std::span<float> absolute2d;   // (N, 2): the same, of absolute values pixel by pixel (AbsGS, Ye et al. 2024)
  bool accumulate = false;
};

// The gradient of a loss from its gradients to the rendered colours and alphas (an empty span is zero). The Gaussians,
// view, options and background are those of the forward pass.
void rasterize_backward(const RasterState& state, const Gaussians& gaussians, std::span<const float> background,
                        std::span<const float> grad_colors, std::span<const float> grad_alphas, const Gradients& out);

// Results of projection, one row a Gaussian; rows of Gaussians out of view are zero.
struct Projections {
  std::span<float> means2d;               // (N, 2) [px]
  std::span<float> depths;                // (N,)
  std::span<float> conics;                // (N, 3): the inverse of the 2D covariance, upper triangle [px^-2]
  std::span<std::int32_t> radii;          // (N, 2) [px]
  std::span<float> opacities;             // (N,), as blended: after antialiasing
};
void describe_projections(const RasterState& state, const Projections& out);

// In how many pixels each Gaussian counts. out: (N,).
void count_contributions(const RasterState& state, std::span<std::int32_t> out);

std::size_t gaussian_count(const RasterState& state);

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
