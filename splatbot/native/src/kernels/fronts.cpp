// SPDX-License-Identifier: Apache-2.0
// The first Gaussians of each pixel: the forward pass again, with ids in place of colours, up to the last one needed.
#include "entry.hpp"
#include "walk.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

// Names the Gaussian in the pixels of a block that it takes from above to half; true if some pixel is still above.
bool halve_block(const Lines& lines, std::uint32_t id, int block, F limit, Through& through, std::int32_t* ids) {
  const F half = set1(0.5F);
  std::uint32_t above = 0;
  for (int part = 0; part < kParts; ++part) {
    const auto first = static_cast<std::size_t>(block * kBlockPixels + part * W);
    const F before = load(through.values + first);
    F after = before;
    advance(alpha_at(lines, block, first), after, limit);
    store(through.values + first, after);
    for (std::uint32_t met = bits((before > half) & (after <= half)); met != 0; met &= met - 1) {
      ids[first + static_cast<std::size_t>(__builtin_ctz(met))] = static_cast<std::int32_t>(id);
    }
    above |= bits(after > half);
  }
  return above != 0;
}

// The pixels of a tile for which fronts are wanted.
struct Wanted {
  std::int16_t entry[kTilePixels];  // among the tile's, -1: none
  std::uint32_t lanes[kBlocks];     // bit by bit
  std::uint32_t found[kTilePixels];  // by entry
  std::uint32_t blocks = 0;

  Wanted(const std::uint32_t* pixels, std::uint32_t count) {
    std::memset(entry, 0xff, sizeof(entry));
    std::memset(lanes, 0, sizeof(lanes));
    std::memset(found, 0, sizeof(found));
    for (std::uint32_t i = 0; i < count; ++i) {
      entry[pixels[i]] = static_cast<std::int16_t>(i);
      lanes[pixels[i] / kBlockPixels] |= 1U << (pixels[i] % kBlockPixels);
      blocks |= 1U << (pixels[i] / kBlockPixels);
    }
  }
};

void pick_block(const FrontArgs& args, const Lines& lines, std::uint32_t id, int block, std::uint32_t first_entry,
                F limit, Through& through, Wanted& wanted) {
  alignas(64) float weights[W];
  for (int part = 0; part < kParts; ++part) {
    const auto first = static_cast<std::size_t>(block * kBlockPixels + part * W);
    F left = load(through.values + first);
    const Step step = advance(alpha_at(lines, block, first), left, limit);
    store(through.values + first, left);
    store(weights, step.weight);
    std::uint32_t met = bits(step.weight > set1(0.0F)) & (wanted.lanes[block] >> (part * W));
    for (; met != 0; met &= met - 1) {
      const int lane = __builtin_ctz(met);
      const auto entry = static_cast<std::uint32_t>(wanted.entry[first + static_cast<std::size_t>(lane)]);
      const std::size_t row = args.rows[first_entry + entry];
      const std::size_t at = row * args.depth + wanted.found[entry];
      args.ids[at] = static_cast<std::int32_t>(id);
      args.weights[at] = weights[lane];
      if (++wanted.found[entry] == args.depth) {
        wanted.lanes[block] &= ~(1U << (part * W + lane));
      }
    }
  }
  if (wanted.lanes[block] == 0) {
    wanted.blocks &= ~(1U << block);
  }
}

}  // namespace

void medians(const MedianArgs& args, std::size_t tile) {
  const BlendArgs& f = args.forward;
  const F limit = set1(f.transmittance_min);
  const TileFrame frame = tile_frame(f.view, f.columns, tile);
  Through through;
  open_pixels(f, frame, through.values);
  std::int32_t ids[kTilePixels];
  std::memset(ids, 0xff, sizeof(ids));
  std::uint32_t waiting = ~0U;
  each_reached(f, frame, tile, waiting, [&](const Lines& lines, std::uint32_t id, int block) {
    if (!halve_block(lines, id, block, limit, through, ids)) {
      waiting &= ~(1U << block);
    }
  });
  for (int y = 0; y < frame.height; ++y) {
    std::int32_t* line = args.ids + static_cast<std::size_t>(frame.y0 + y) * static_cast<std::size_t>(f.view.width);
    for (int x = 0; x < frame.width; ++x) {
      line[frame.x0 + x] = ids[pixel_index(x, y)];
    }
  }
}

void fronts(const FrontArgs& args, std::size_t tile) {
  const BlendArgs& f = args.forward;
  const F limit = set1(f.transmittance_min);
  const std::uint32_t first_entry = args.tile_pixels[tile], entries = args.tile_pixels[tile + 1] - first_entry;
  if (entries == 0) {
    return;
  }
  const TileFrame frame = tile_frame(f.view, f.columns, tile);
  Through through;
  open_pixels(f, frame, through.values);
  Wanted wanted(args.pixels + first_entry, entries);
  each_reached(f, frame, tile, wanted.blocks, [&](const Lines& lines, std::uint32_t id, int block) {
    pick_block(args, lines, id, block, first_entry, limit, through, wanted);
  });
}

}  // namespace splatbot::SPLATBOT_KERNELS
