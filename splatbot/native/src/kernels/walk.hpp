// SPDX-License-Identifier: Apache-2.0
// Ways through a tile's pairs and pixels that the passes over Gaussians and surfels share.
#pragma once

#include "image.hpp"
#include "reach.hpp"
#include "tile.hpp"

#define SB_INLINE_LAMBDA __attribute__((always_inline))

namespace splatbot::SPLATBOT_KERNELS {

// Transmittance of a tile's pixels on the way; see advance().
struct Through {
  alignas(64) float values[kTilePixels];
};

// Before the first splat: 1 in the pixels to render, 0 elsewhere.
inline void open_pixels(const BlendArgs& args, const TileFrame& frame, float* through) {
  const bool whole = whole_tile(frame) && args.mask == nullptr;
  for (int i = 0; i < kTilePixels; ++i) {
    through[i] = whole ? 1.0F : 0.0F;
  }
  for (int y = 0; y < frame.height && !whole; ++y) {
    for (int x = 0; x < frame.width; ++x) {
      through[pixel_index(x, y)] = kept(args, frame.x0 + x, frame.y0 + y) ? 1.0F : 0.0F;
    }
  }
}

// Calls each() with a constant that is at least a pass's number of channels. Further channels of a record are zero.
template <class Each>
SB_INLINE void with_channels(int count, Each each) {
  switch (count) {
    case 1:
      return each(Constant<1>{});
    case 2:
    case 3:
      return each(Constant<3>{});
    case 4:
      return each(Constant<4>{});
    case 5:
    case 6:
      return each(Constant<6>{});
    default:
      return each(Constant<8>{});
  }
}

// Calls each() with a constant that equals a flag.
template <class Each>
SB_INLINE void with_flag(bool flag, Each each) {
  if (flag) {
    each(Constant<true>{});
  } else {
    each(Constant<false>{});
  }
}

// The same as with_channels() for surfels, whose records have no channels in addition to their colours.
template <class Each>
SB_INLINE void with_surfel_channels(int count, Each each) {
  if (count == 0) {
    each(Constant<0>{});
  } else if (count <= 3) {
    each(Constant<3>{});
  } else {
    each(Constant<kMaxSurfelChannels>{});
  }
}

// A bit for each block with an open pixel.
inline std::uint32_t live_blocks(const float* through, F limit) {
  std::uint32_t live = 0;
  for (int b = 0; b < kBlocks; ++b) {
    std::uint32_t open = 0;
    for (int part = 0; part < kParts; ++part) {
      open |= bits(load(through + b * kBlockPixels + part * W) > limit);
    }
    live |= static_cast<std::uint32_t>(open != 0) << b;
  }
  return live;
}

// Blends a tile's pairs front to back, kChunk at a time, until no pixel is open. `load_chunk` reads n pairs from `at` on
// into a chunk, with their masks of live blocks, 0 beyond n. The masks are kept for the backward pass. `blend` takes the
// members of a chunk that reach a block into one part of it.
template <class Chunk, class Args, class Load, class Blend>
SB_INLINE void blend_chunks(const Args& args, std::size_t tile, const float* through, F limit, Load load_chunk,
                            Blend blend) {
  Chunk chunk;
  const std::uint32_t begin = args.tile_begin[tile];
  const std::uint32_t end = args.tile_begin[tile + 1];
  std::uint32_t at = begin;
  std::uint32_t live = live_blocks(through, limit);
  while (at < end && live != 0) {
    const int n = end - at < kChunk ? static_cast<int>(end - at) : kChunk;
    load_chunk(at, n, live, chunk);
    for (std::uint32_t next = at + kChunk; next < at + 2 * kChunk && next < end; ++next) {
      __builtin_prefetch(args.records + args.pairs[next].id);
    }
    std::memcpy(args.masks + at, chunk.masks, static_cast<std::size_t>(n) * sizeof(chunk.masks[0]));
    transpose_masks(chunk.masks, chunk.columns);
    for (std::uint32_t left = live; left != 0; left &= left - 1) {
      const int block = __builtin_ctz(left);
      const std::uint64_t members = chunk.columns[block];
      if (members != 0) {
        for (int part = 0; part < kParts; ++part) {
          blend(chunk, members, at, block, part);
        }
      }
    }
    live = live_blocks(through, limit);
    at += static_cast<std::uint32_t>(n);
  }
  args.tile_done[tile] = at - begin;
}

// Calls sum(at, mask, slot) for each pair of a tile that reached live blocks, front to back; zeros the other slots.
template <int SlotSize, class Args, class Sum>
SB_INLINE void each_slot(const Args& args, std::size_t tile, Sum sum) {
  const auto& f = args.forward;
  const std::uint32_t begin = f.tile_begin[tile];
  const std::uint32_t end = f.tile_begin[tile + 1];
  const std::uint32_t done = begin + f.tile_done[tile];
  for (std::uint32_t at = begin; at < end; ++at) {
    float* slot = args.slots + static_cast<std::size_t>(f.pairs[at].slot) * SlotSize;
    const std::uint32_t mask = at < done ? f.masks[at] : 0U;
    if (mask == 0) {
      std::memset(slot, 0, SlotSize * sizeof(float));
      continue;
    }
    constexpr std::uint32_t kAhead = 8;
    if (at + kAhead < done) {
      const auto* record = reinterpret_cast<const char*>(f.records + f.pairs[at + kAhead].id);
      for (std::size_t line = 0; line < sizeof(f.records[0]); line += 64) {
        __builtin_prefetch(record + line);
      }
      __builtin_prefetch(args.slots + static_cast<std::size_t>(f.pairs[at + kAhead].slot) * SlotSize, 1);
    }
    sum(at, mask, slot);
  }
}

// Calls each(block, first) for the parts of the blocks in a mask that is not empty; `first` is a part's first pixel.
template <class Each>
SB_INLINE void each_part_of(std::uint32_t mask, Each each) {
  do {
    const int block = __builtin_ctz(mask);
    mask &= mask - 1;
#pragma GCC unroll 4
    for (int part = 0; part < kParts; ++part) {
      each(block, static_cast<std::size_t>(block * kBlockPixels + part * W));
    }
  } while (mask != 0);
}

// Alpha x d loss / d alpha, from the gradient to the weight and the rest behind it. It is zero where the cap holds
// alpha and in closed pixels.
SB_INLINE F pull_back_alpha(const Alpha& a, const Step& step, F along, F rest) {
  const F other = a.alpha * reciprocal(a.left) * rest;
  const M free = step.open & (a.power <= set1(kAlphaMax));
  return zero_unless(free, fms(step.weight, along, other));
}

// Calls each(lines, id, block) for a tile's Gaussians, front to back, and each block in `wanted` that they reach. It
// ends when no block is wanted.
template <class Each>
SB_INLINE void each_reached(const BlendArgs& args, const TileFrame& frame, std::size_t tile,
                            const std::uint32_t& wanted, Each each) {
  const std::uint32_t begin = args.tile_begin[tile], done = begin + args.tile_done[tile];
  for (std::uint32_t at = begin; at < done && wanted != 0; ++at) {
    std::uint32_t mask = args.masks[at] & wanted;
    if (mask == 0) {
      continue;
    }
    const std::uint32_t id = args.pairs[at].id;
    Lines lines;
    localize(args.records[id], frame, lines);
    for (; mask != 0; mask &= mask - 1) {
      each(lines, id, __builtin_ctz(mask));
    }
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
