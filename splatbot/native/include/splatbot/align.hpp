// SPDX-License-Identifier: Apache-2.0
// Rigid RGB-D alignment: reference points against images of the current frame, by Gauss-Newton.
#pragma once

#include <array>
#include <cstddef>
#include <span>
#include <vector>

#include "splatbot/align_residuals.hpp"

namespace splatbot {

constexpr int kAlignCellColumns = 8, kAlignCellRows = 6;

// A keyframe to align to: its points on each level, and where it stands.
struct AlignReference {
  std::array<double, 16> T_world_reference;
  std::vector<AlignPoints> levels;  // fine to coarse
};

// World points matched with pixels of the current frame, and the intrinsics of those pixels.
struct AlignMatches {
  double fx = 1, fy = 1, cx = 0, cy = 0;
  std::span<const double> points;  // (M, 3) [m]
  std::span<const double> pixels;  // (M, 2)
  std::span<const double> sigmas;  // (M,) [px]
};

// Prior of the pose: its mean, and the information of the twist (t, ω) that left-multiplies it.
struct AlignPrior {
  std::array<double, 16> T_camera_world;
  std::array<double, 36> information{};  // (6, 6)
};

struct AlignPlan {
  AlignSettings settings;
  double dense_weight = 1.0;  // of a dense residual against a match's: neighbours are correlated
  int iterations = 5;         // per level, at most
  std::size_t finest = 0;     // level to end on
  // If positive, the last level weights both kinds of residuals by the spread that they show. Dense residuals get this share
  // of their weight, as their errors correlate across cells as well (rolling shutter, late depth).
  double dense_share = 0.0;
};

struct AlignResult {
  std::array<double, 16> T_camera_world;
  std::array<double, 36> H{};       // (6, 6) information of the last linearisation, without the prior's
  std::array<double, 36> curvature{};  // (6, 6) Hessian of the robust cost; outliers make it smaller than H
  std::array<double, 36> spread{};  // (6, 6) Σ g gᵀ over the cells of the image, g the gradient of a cell's residuals
  double dense_weight = 0, match_weight = 0;  // of one residual, at the end
  std::size_t cells = 0;            // cells that have residuals
  std::array<double, 36 * kAlignCellRows> band_H{};  // (6, 6) normal equations of the residuals in each row of cells
  std::array<double, 6 * kAlignCellRows> band_g{};   // (6,) and their gradients
};

// Gauss-Newton over the levels, coarse to fine: H δ = -g with H = Σ w JᵀJ and g = Σ w Jᵀr, then T <- exp(δ) T. Each reference
// has its own exposure, which the Schur complement marginalises. It starts neutral on every level. `prior` may be null.
// Without a prior, levels above the finest with fewer than 60 points and matches are skipped.
//
// The spread is evaluated at the result over kAlignCellColumns x kAlignCellRows cells. It includes errors common to the
// residuals of a cell (blur, a wrong depth of a surface). The noise model does not cover them. With the curvature C,
// C⁻¹ spread C⁻¹ is the cluster-robust covariance (Huber 1967; Liang and Zeger 1986).
AlignResult align(std::span<const AlignImage> levels, std::span<const AlignReference> references,
                  const AlignMatches& matches, const AlignPrior* prior, std::span<const double, 16> T_camera_world,
                  const AlignPlan& plan);

}  // namespace splatbot
