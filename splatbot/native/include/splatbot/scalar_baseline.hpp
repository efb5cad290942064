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

// What `splatbot bench` compares with, and nothing else uses: the same model written the plain way, on one thread,
// without vectors. Gaussians are projected one after the other, each tile of 16x16 pixels lists those whose box of
// 3.33 sigma meets it, and each pixel walks its tile's list. Renders RGB (H, W, 3) and alphas (H, W). Unless
// `grad_colors` (H, W, 3) is empty, it then walks the lists back to front for the gradients to colours, opacities and
// the projected means and inverse covariances; the chain from there to 3D is left out, in the baseline's favour.
void scalar_baseline(const Gaussians& gaussians, const View& view, const RasterOptions& options,
                     std::span<float> out_colors, std::span<float> out_alphas, std::span<const float> grad_colors,
                     const ScalarGradients& gradients);

}  // namespace splatbot
