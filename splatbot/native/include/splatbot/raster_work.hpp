// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "splatbot/rasterizer.hpp"

namespace splatbot {

// Milliseconds of each stage, of the last forward and the last backward pass.
struct StageTimes {
  double project = 0.0, order = 0.0, list_tiles = 0.0, blend = 0.0;
  double blend_backward = 0.0, project_backward = 0.0;
};

const StageTimes& stage_times(const RasterState& state);

// (Gaussian, pixel) pairs that one blend pass evaluates: the pixels of the 4x4 blocks that each Gaussian's mask names.
std::uint64_t evaluated_pairs(const RasterState& state);

}  // namespace splatbot
