// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>

#include "splatbot/rasterizer.hpp"

namespace splatbot {

struct ScalarGradients {
  std::span<float> colors, opacities;
  std::span<float> means2d;  // (N, 2)
  std::span<float> conics;   // (N, 3)
};

// The rasterizer's model in textbook C++, on one thread and without vectors: a baseline that only `splatbot bench` uses.
// Gaussians are projected one by one (Zwicker et al., "EWA splatting", 2002). Each tile of 16x16 pixels lists the Gaussians
// whose box of 3.33 σ meets it. Each pixel blends its tile's list, C = Σ c_i α_i T_i with T_i = Π_{j<i} (1 - α_j). The output
// is RGB (H, W, 3) and alpha (H, W). Unless `grad_colors` (H, W, 3) is empty, a second pass from back to front computes the
// gradients of colours, opacities, projected means and inverse covariances. It omits the chain from there to 3D.
void scalar_baseline(const Gaussians& gaussians, const View& view, const RasterOptions& options,
                     std::span<float> out_colors, std::span<float> out_alphas, std::span<const float> grad_colors,
                     const ScalarGradients& gradients);

}  // namespace splatbot
