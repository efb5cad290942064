// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "splatbot/isas.hpp"
#include "splatbot/raster_state.hpp"
#include "splatbot/surfel_kernels.hpp"

// The compute kernels, compiled once for each instruction set from the sources in src/kernels. They see plain pointers
// only: an inline function of the standard library would be emitted in several copies of which the linker keeps any.
namespace splatbot {

inline constexpr float kAlphaMin = 1.0F / 255.0F;
inline constexpr float kLog2AlphaMin = -7.994353436858858F;
inline constexpr float kAlphaMax = 0.99F;
inline constexpr float kTransmittanceMin = 1e-4F;
inline constexpr float kMaxSigmas = 3.33F;
inline constexpr float kExpectedDepthMin = 1e-10F;  // least sum of weights that expected depth is divided by
inline constexpr float kMinAntialias = 0.005F;      // least factor on opacity
inline constexpr float kFovMargin = 0.3F;           // of half the field of view, where slopes are clamped

struct ProjectArgs {
  std::size_t count;
  const float *means, *quats, *scales, *covars, *opacities, *colors;
  int channels;
  int sh_degree, coefficients;  // degree -1: colours are colours
  View view;
  RasterOptions options;
  int columns, rows;
  const ChannelPass* passes;
  int n_passes;
  Record* records;
  Placement* placements;
  std::uint32_t* visible;
  float* more_channels;
};

struct BlendArgs {
  View view;
  int columns;
  const ChannelPass* pass;
  DepthMode depth;
  bool plane_depth;
  bool write_alphas;
  float transmittance_min;
  const Record* records;
  const float* channels;  // of Gaussian 0; rows `channel_stride` apart
  std::size_t channel_stride;
  const std::uint32_t* tile_begin;
  const Pair* pairs;
  std::uint32_t* masks;
  std::uint32_t* tile_done;
  float* final_state;  // of this pass
  const float* background;  // per channel of the pass, or null
  const std::uint8_t* mask;  // of square tiles of mask_size pixels, or null
  int mask_size, mask_columns;
  float* out_colors;
  int out_channels;
  float* out_alphas;
};

struct BlendBackwardArgs {
  BlendArgs forward;
  const float* grad_colors;  // (H, W, out_channels) or null
  const float* grad_alphas;  // (H, W) or null; null for all but the first pass
  int channel_sums;          // how many channels' gradients are summed: 0, 1 (depth) or all
  bool geometry;             // not the colours' gradients alone
  bool absolute;             // sum absolute gradients of the centre as well
  float* slots;              // (pairs, kSlot)
};

struct ProjectBackwardArgs {
  ProjectArgs forward;
  const ProjectedBlock* blocks;
  const float* slots;
  const ChannelPass* pass;
  int channel_sums;
  bool depth_in_pass;
  float* carried;   // (N, kSlot) sums of earlier passes, or null if there is one pass only
  bool first, last;
  bool accumulate;  // add to the outputs
  bool accumulate_colors;
  bool geometry;  // not the colours' gradients alone
  // Outputs; null if not requested.
  float *means, *quats, *scales, *covars, *opacities, *colors, *means2d, *absolute2d;
  double* camera;  // (blocks, kCameraSums) partial sums
};

// Harmonics of the Gaussians in view. The colours go to the records of either kind of splat; their gradients come
// from there.
struct HarmonicsArgs {
  std::size_t count;
  const float *means, *coefficients;  // (N, 3), (N, held, 3)
  int degree, held;
  View view;
  const std::uint32_t* visible;
  const ProjectedBlock* blocks;
  float* colors;  // of Gaussian 0; rows `color_stride` apart
  std::size_t color_stride;
};

struct HarmonicsBackwardArgs {
  HarmonicsArgs forward;
  const float* colors;  // (N, 3): gradient to the colours of Gaussians in view
  bool accumulate;      // add to the coefficients' gradient
  float* coefficients;  // output, or null
  float* means;         // output, always added to, or null
  double* center;       // (blocks, 3): gradient to the camera's centre, or null
};

struct ContributionArgs {
  BlendArgs forward;
  std::uint32_t* counts;  // (pairs,), by slot
};

inline constexpr int kLinearizeChunk = 256;

// One chunk of at most kLinearizeChunk points against one image; see align_residuals.hpp for the terms.
struct LinearizeArgs {
  int width, height;
  float fx, fy, cx, cy;
  const float *gray, *depth;
  int count;
  const float *points, *normals, *gray_reference;
  float T[12];  // T_current_reference, row-major
  float gain, offset;
  bool use_photometric, use_geometric;
  float sigma_gray, sigma_depth_floor, sigma_depth_quad, gate, nu;
  bool blurred;
  float blur[6];  // see AlignSettings
  float *residual_photometric, *residual_geometric;  // or null
};

struct LinearizeSums {
  double H[64];  // upper triangle
  double g[8];
  double cost;
  std::size_t projected, photometric, geometric;
};

struct MedianArgs {
  BlendArgs forward;
  std::int32_t* ids;  // (H, W)
};

struct FrontArgs {
  BlendArgs forward;
  const std::uint32_t* tile_pixels;  // (tiles + 1,): where a tile's entries begin
  const std::uint32_t* pixels;       // of each entry, within its tile
  const std::uint32_t* rows;         // of each entry, in the outputs
  std::size_t depth;                 // Gaussians to a row
  std::int32_t* ids;
  float* weights;
};

// The fused loss; see loss.hpp.
inline constexpr int kWindow = 11;
inline constexpr int kWindowReach = kWindow / 2;
inline constexpr float kSsimC1 = 0.01F * 0.01F;
inline constexpr float kSsimC2 = 0.03F * 0.03F;

// A tile's scratch: this many lines of LossArgs::stride floats.
inline constexpr int kLossLines = 12 + 7 * kWindow;

struct LossArgs {
  int width, height, channels;
  const float *rendered, *target;  // (images, H, W, channels)
  const std::uint8_t* mask;        // (images, H, W) or null
  int margin;                      // pixels at the border that are no window's centre
  int tile_width, tile_height, columns, rows;  // [px], [tiles]
  int stride;                                  // of a line: a row with both blurs' reach, and a vector beyond
  float window[kWindow];
  float l1_scale, ssim_scale;  // of the two sums in the loss
  float* gradient;             // as rendered, or null
};

struct alignas(64) LossSums {
  double l1, ssim;
};

// One group of parameters of Adam: (rows, columns) each.
struct AdamGroup {
  float *values, *first, *second;
  const float* gradient;
  std::size_t columns;
  float rate;
  const float* column_rates;  // (columns,), multiplied with `rate`; or null
};

// Steps one block of rows. `step_scale` is sqrt(1 - b2^t) / (1 - b1^t) of each row, 0 for a row that is not stepped. `eps` is scaled by sqrt(1 - b2^t) as well.
struct AdamBlock {
  std::size_t begin, count;
  const float *step_scale, *eps;
  float beta1, beta2;
  float* scratch;  // 2 x count x columns of the widest group, padded
};

struct FieldKernels;  // field_kernels.hpp
struct ArmKernels;    // arm_kernels.hpp
struct PlanKernels;   // planning/kernels.hpp

struct Kernels {
  const char* name;
  SplatKernels<ProjectArgs, BlendArgs, BlendBackwardArgs, ProjectBackwardArgs> gaussians;
  SurfelKernels surfels;
  void (*linearize)(const LinearizeArgs&, LinearizeSums& sums);
  void (*harmonics)(const HarmonicsArgs&, std::size_t block);
  void (*harmonics_backward)(const HarmonicsBackwardArgs&, std::size_t block);
  void (*contributions)(const ContributionArgs&, std::size_t tile);
  void (*medians)(const MedianArgs&, std::size_t tile);
  void (*fronts)(const FrontArgs&, std::size_t tile);
  void (*loss)(const LossArgs&, std::size_t tile, float* scratch, LossSums& sums);
  void (*adam)(const AdamGroup&, const AdamBlock&);
  const FieldKernels* field;
  const ArmKernels* arm;
  const PlanKernels* plan;
  int lanes;
};

// The kernels in use (isa.cpp).
const Kernels& kernels();

#define SPLATBOT_DECLARE_KERNELS(isa) \
  namespace isa {                      \
  extern const Kernels kKernels;       \
  }
SPLATBOT_EACH_ISA(SPLATBOT_DECLARE_KERNELS)
#undef SPLATBOT_DECLARE_KERNELS

}  // namespace splatbot
