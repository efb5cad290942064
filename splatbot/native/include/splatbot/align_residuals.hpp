// SPDX-License-Identifier: Apache-2.0
// Residuals of reference points against an image of the current frame, and their linearisation at a pose.
#pragma once

#include <array>
#include <cstddef>
#include <span>

namespace splatbot {

// A pinhole image of the current frame; integer coordinates are pixel centres.
struct AlignImage {
  int width = 0, height = 0;
  double fx = 0, fy = 0, cx = 0, cy = 0;
  std::span<const float> gray;   // (H, W) intensity, NaN where it may not be used
  std::span<const float> depth;  // (H, W) [m], 0 = missing
};

// Reference points, in the reference camera's frame.
struct AlignPoints {
  std::span<const float> points;   // (N, 3) [m]
  std::span<const float> normals;  // (N, 3), zero where unknown: then only photometry is used
  std::span<const float> gray;     // (N,) intensity
};

struct AlignSettings {
  bool use_photometric = true;
  bool use_geometric = true;
  double sigma_gray = 0.02;         // [intensity]
  double sigma_depth_floor = 1e-3;  // [m]
  double sigma_depth_quad = 2e-3;   // [1/m]: σ_z = floor + quad z²
  double gate = 0.1;                // [m] depths that differ by more, beyond 3 σ_z, are of another surface
  // Standard deviation β (t, ω) of the motion by which a blurred image may be displaced. A residual with the Jacobian J
  // has the variance σ² + (J β)². Zero for a sharp image.
  std::array<double, 6> blur{};
  double nu = 4.0;                  // weight w = (ν + 1) / (ν + r²/σ²) (Student t; Kerl et al. 2013)
};

// Sums over all residuals. State: left-multiplied twist (t, ω) of T_current_reference, then gain a and offset b of
// current = a · reference + b.
struct AlignSums {
  std::array<double, 64> H{};  // (8, 8)
  std::array<double, 8> g{};   // Jᵀ W r
  double cost = 0.0;           // Σ (ν + 1)/2 · log(1 + r²/(ν σ²))
  std::size_t projected = 0;   // points that land inside the image
  std::size_t photometric = 0, geometric = 0;
};

// One linearisation. T_current_reference is row-major (4, 4). residual_photometric and residual_geometric, (N,) each or
// empty, receive r/σ, NaN where a point has none. The sums run over fixed chunks in fixed order.
AlignSums linearize_alignment(const AlignImage& image, const AlignPoints& reference,
                              std::span<const double, 16> T_current_reference, double gain, double offset,
                              const AlignSettings& settings, std::span<float> residual_photometric,
                              std::span<float> residual_geometric);

// Inverse of the block of H that belongs to the exposure, its elements 00, 01 and 11. Exposure is anchored weakly to gain
// 1 and offset 0, so that a blank image leaves it defined.
constexpr double kExposurePrior = 1e2;
std::array<double, 3> exposure_inverse(const AlignSums& sums);

// Residuals at a pose, as above, with the exposure {gain, offset} that fits it best.
std::array<double, 2> align_residuals(const AlignImage& image, const AlignPoints& reference,
                                      std::span<const double, 16> T_current_reference, const AlignSettings& settings,
                                      std::span<float> residual_photometric, std::span<float> residual_geometric);

}  // namespace splatbot
