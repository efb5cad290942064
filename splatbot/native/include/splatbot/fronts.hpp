// SPDX-License-Identifier: Apache-2.0
// The front Gaussians of each pixel in a finished render.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

#include "splatbot/raster_state.hpp"

namespace splatbot {

// The Gaussian at which a pixel's transmittance falls to 1/2 or below, -1 where it stays above. out: (H, W).
void median_gaussians(const RasterState& state, std::span<std::int32_t> out);

// The front `depth` Gaussians that contribute to each of P pixels (y W + x, each once), and their blend weights. Ids
// and weights are (P, depth), front to back, then -1 and 0.
void front_gaussians(const RasterState& state, std::span<const std::int64_t> pixels, std::size_t depth,
                     std::span<std::int32_t> ids, std::span<float> weights);

}  // namespace splatbot
