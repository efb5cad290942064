// SPDX-License-Identifier: Apache-2.0
#include "splatbot/raster_work.hpp"

#include <bit>

#include "splatbot/raster_state.hpp"

namespace splatbot {

const StageTimes& stage_times(const RasterState& state) { return state.times; }

std::uint64_t evaluated_pairs(const RasterState& state) {
  std::uint64_t blocks = 0;
  for (std::size_t tile = 0; tile < state.tiles(); ++tile) {
    const std::size_t begin = state.tile_begin[tile];
    for (std::size_t i = begin; i < begin + state.tile_done[tile]; ++i) {
      blocks += static_cast<std::uint64_t>(std::popcount(state.masks[i]));
    }
  }
  return blocks * static_cast<std::uint64_t>(kBlockPixels);
}

}  // namespace splatbot
