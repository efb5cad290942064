// SPDX-License-Identifier: Apache-2.0
// In how many pixels each Gaussian of a tile counts: the forward pass over again, with counts in place of colours.
#include "entry.hpp"
#include "walk.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

std::uint32_t count_pair(const Lines& lines, std::uint32_t mask, F limit, Through& through) {
  std::uint32_t count = 0;
  for (; mask != 0; mask &= mask - 1) {
    const int block = __builtin_ctz(mask);
    for (int part = 0; part < kParts; ++part) {
      const auto first = static_cast<std::size_t>(block * kBlockPixels + part * W);
      F left = load(through.values + first);
      const Step step = advance(alpha_at(lines, block, first), left, limit);
      store(through.values + first, left);
      count += static_cast<std::uint32_t>(__builtin_popcount(bits(step.weight > set1(0.0F))));
    }
  }
  return count;
}

}  // namespace

void contributions(const ContributionArgs& args, std::size_t tile) {
  const BlendArgs& f = args.forward;
  const TileFrame frame = tile_frame(f.view, f.columns, tile);
  const F limit = set1(f.transmittance_min);
  Through through;
  open_pixels(f, frame, through.values);
  const std::uint32_t begin = f.tile_begin[tile], done = begin + f.tile_done[tile];
  for (std::uint32_t at = begin; at < f.tile_begin[tile + 1]; ++at) {
    const Pair& pair = f.pairs[at];
    Lines lines;
    localize(f.records[pair.id], frame, lines);
    args.counts[pair.slot] = at < done ? count_pair(lines, f.masks[at], limit, through) : 0U;
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
