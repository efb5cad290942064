// SPDX-License-Identifier: Apache-2.0
// The surfels' kernels, compiled once for each instruction set; see kernels.hpp.
#pragma once

#include "splatbot/raster_state.hpp"
#include "splatbot/surfels.hpp"

namespace splatbot {

inline constexpr float kFilter = 2.0F;          // 1 / variance of the low-pass filter [px^-2]
inline constexpr float kLeastScale = 1e-6F;     // [px]; a thinner disc counts as this thick
inline constexpr float kMedianLight = 0.5F;     // transmittance at which the median depth is

// A projected surfel, two cache lines. Its centre is (mx + part_x, my + part_y), where the first parts are whole
// pixels. A single float of a pixel's place in a large image has too few digits for a thin disc. Let d = pixel centre
// - centre and D = kappa + h d. The ray meets the disc at u = (b d)_0 / D, v = (b d)_1 / D [standard deviations] and
// depth z kappa / D.
struct alignas(64) SurfelRecord {
  float mx, my, part_x, part_y;
  float b[4];    // row-major
  float kappa;   // normal . ray of the centre, >= 0; 0 edge-on
  float hx, hy;
  float z;
  float lo;      // log2 of the opacity
  float circle;  // [px] that the low-pass filter reaches
  // The ellipse that the disc covers, as in Record, with a reach of 1; l11 = 0 if it has none and may cover anything.
  float ex, ey, l11, l21, l22, lean;
  float flip;       // -1 if t0 x t1 points towards the camera (see Surfel)
  float normal[3];  // world frame, facing the camera
  float channels[kMaxSurfelChannels];
};
static_assert(sizeof(SurfelRecord) == 128);

// Sums of one (surfel, tile) pair. With g = d loss / d log(alpha) they are g and the numerators of u, v and D
// times (dx, dy, 1). Next are z kappa, the depth of the centre, and the low-pass dx, dy. Weights times gradients of normals and colours follow.
enum SurfelSum : int {
  kSumAlpha,
  kSumU,
  kSumV = kSumU + 3,
  kSumD = kSumV + 3,
  kSumHitDepth = kSumD + 3,
  kSumCenterDepth,
  kSumPointX,
  kSumPointY,
  kSurfelGeometrySums,
  kSumNormal = 16,  // where a second reduction of 16 sums begins
  kSumColor = kSumNormal + 3,
};
inline constexpr int kSurfelSlot = 32;
static_assert(kSurfelGeometrySums <= 16 && kSumColor + kMaxSurfelChannels <= kSurfelSlot);

// State that a blend keeps of each pixel for its backward pass.
enum SurfelPlane : int {
  kPlaneTransmittance,
  kPlaneWeights,  // sum of weights
  kPlaneDepth,    // weighted sums from here on
  kPlaneNormal,
  kPlaneColor = kPlaneNormal + 3,
  kPlaneMedian = kPlaneColor + kMaxSurfelChannels,  // place in the tile's list, as an integer; -1: none
  kPlaneDistortion,
  kPlaneSign,       // sum of sign x weight, of distortion
  kPlaneSignDepth,  // sum of sign x weight x depth
  kSurfelPlanes,
};

struct SurfelProjectArgs {
  std::size_t count;
  const float *means, *quats, *scales, *covars, *opacities, *colors;  // covars: null
  int channels;
  int sh_degree, coefficients;  // degree -1: colours are colours
  View view;
  SurfelOptions options;
  int columns, rows;
  SurfelRecord* records;
  Placement* placements;
  std::uint32_t* visible;
};

struct SurfelBlendArgs {
  View view;
  SurfelOptions options;
  int columns;
  int channels;
  const SurfelRecord* records;
  const std::uint32_t* tile_begin;
  const Pair* pairs;
  std::uint32_t* masks;
  std::uint32_t* tile_done;
  float* final_state;       // (tiles, kSurfelPlanes, kTilePixels)
  const float* background;  // (channels,) or null
  float *colors, *alphas, *normals, *median, *distortion;
};

struct SurfelBlendBackwardArgs {
  SurfelBlendArgs forward;
  const float *colors, *alphas, *normals, *median, *distortion;  // gradients; null: zero
  bool sum_channels;  // of normals and colours
  float* slots;       // (pairs, kSurfelSlot)
};

struct SurfelProjectBackwardArgs {
  SurfelProjectArgs forward;
  const ProjectedBlock* blocks;
  const float* slots;
  bool sum_channels;
  bool accumulate;  // add to the outputs
  bool accumulate_colors;
  float *means, *quats, *scales, *opacities, *colors, *means2d;  // outputs; null if not requested
  double* camera;                                                // (blocks, kCameraSums) partial sums, or null
};

using SurfelKernels =
    SplatKernels<SurfelProjectArgs, SurfelBlendArgs, SurfelBlendBackwardArgs, SurfelProjectBackwardArgs>;

}  // namespace splatbot
