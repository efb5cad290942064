// SPDX-License-Identifier: Apache-2.0
// Front-to-back blending of one tile. 64 Gaussians at a time: their block masks are found first, then each block goes
// through the Gaussians that reach it with its transmittance and colours in registers.
#include "entry.hpp"
#include "reach.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

// Rows of a chunk: Local, slopes of plane depth, channels.
constexpr int kRow = 16;
constexpr int kRowSlopes = 6;
constexpr int kRowChannels = 8;

struct Chunk {
  alignas(64) float rows[kChunk][kRow];
  ChunkEllipses ellipses;
  std::uint32_t masks[kChunk];
  std::uint64_t columns[kBlocks];
};

struct TileState {
  alignas(64) float through[kTilePixels];        // see advance()
  alignas(64) float transmittance[kTilePixels];  // what the Gaussians that count leave
  alignas(64) float channels[kRecordChannels][kTilePixels];
  alignas(64) float weights[kTilePixels];  // for expected depth, where 1 - transmittance has too few digits if small
};

// What a blend does besides summing channels.
struct Extras {
  bool plane;  // depth varies over a footprint
  bool weigh;  // sum the weights
};

void start(const BlendArgs& args, const TileFrame& frame, int channels, TileState& state) {
  for (int i = 0; i < kTilePixels; ++i) {
    const bool inside =
        kCenters.x[i] < static_cast<float>(frame.width) && kCenters.y[i] < static_cast<float>(frame.height);
    state.through[i] = inside ? 1.0F : 0.0F;
    state.transmittance[i] = 1.0F;
  }
  for (int y = 0; args.mask != nullptr && y < frame.height; ++y) {
    for (int x = 0; x < frame.width; ++x) {
      state.through[pixel_index(x, y)] = kept(args, frame.x0 + x, frame.y0 + y) ? 1.0F : 0.0F;
    }
  }
  for (int c = 0; c < channels; ++c) {
    std::memset(state.channels[c], 0, sizeof(state.channels[c]));
  }
  std::memset(state.weights, 0, sizeof(state.weights));
}

template <int C>
SB_INLINE void load_chunk(const BlendArgs& args, const TileFrame& frame, const Pair* pairs, int n, bool slopes,
                          Chunk& chunk) {
  for (int j = 0; j < n; ++j) {
    const Record& record = args.records[pairs[j].id];
    const float* channels = args.channels + pairs[j].id * args.channel_stride;
    float* row = chunk.rows[j];
    const Local local = localize(record, frame);
    std::memcpy(row, &local, sizeof(local));
    std::memcpy(row + kRowChannels, channels, C * sizeof(float));
    if (slopes) {
      const PlaneDepth plane = plane_depth(record, channels, frame);
      row[kRowSlopes] = plane.slope_x;
      row[kRowSlopes + 1] = plane.slope_y;
      row[kRow - 1] = plane.corner;  // at most 6 channels leave it free
    }
    ChunkEllipses& e = chunk.ellipses;
    e.cx[j] = record.mx - static_cast<float>(frame.x0);
    e.cy[j] = record.my - static_cast<float>(frame.y0);
    e.l11[j] = record.l11;
    e.l21[j] = record.l21;
    e.l22[j] = record.l22;
    e.reach[j] = record.reach;
    e.lean[j] = record.lean;
  }
  const int padded = (n + W - 1) / W * W;
  for (int j = n; j < padded; ++j) {  // masked out later; any finite ellipse will do
    ChunkEllipses& e = chunk.ellipses;
    e.cx[j] = e.cy[j] = e.l21[j] = e.lean[j] = e.reach[j] = 0.0F;
    e.l11[j] = e.l22[j] = 1.0F;
  }
}

template <int C, Extras E>
SB_INLINE void blend_block(const Chunk& chunk, std::uint64_t members, std::size_t first, F limit, TileState& state) {
  const F x = load(kCenters.x + first), y = load(kCenters.y + first);
  F through = load(state.through + first);
  F transmittance = load(state.transmittance + first);
  F sum[C];
#pragma GCC unroll 8
  for (int c = 0; c < C; ++c) {
    sum[c] = load(state.channels[c] + first);
  }
  F weights = load(state.weights + first);
  while (members != 0) {
    const float* row = chunk.rows[__builtin_ctzll(members)];
    members &= members - 1;
    const Alpha a = alpha_at(x, y, row, row + 1, row + 2, row + 3, row + 4, row + 5);
    const Step step = advance(a, through, limit);
    transmittance = select(step.open, through, transmittance);
#pragma GCC unroll 8
    for (int c = 0; c < C; ++c) {
      F value = set1(row[kRowChannels + c]);
      if (E.plane && c == 0) {
        value = fma(set1(row[kRowSlopes]), x, fma(set1(row[kRowSlopes + 1]), y, set1(row[kRow - 1])));
      }
      sum[c] = fma(step.weight, value, sum[c]);
    }
    if (E.weigh) {
      weights = weights + step.weight;
    }
  }
  store(state.through + first, through);
  store(state.transmittance + first, transmittance);
#pragma GCC unroll 8
  for (int c = 0; c < C; ++c) {
    store(state.channels[c] + first, sum[c]);
  }
  if (E.weigh) {
    store(state.weights + first, weights);
  }
}

std::uint32_t live_blocks(const TileState& state, F limit) {
  std::uint32_t live = 0;
  for (int b = 0; b < kBlocks; ++b) {
    std::uint32_t open = 0;
    for (int part = 0; part < kParts; ++part) {
      open |= bits(load(state.through + b * kBlockPixels + part * W) > limit);
    }
    live |= static_cast<std::uint32_t>(open != 0) << b;
  }
  return live;
}

template <int C, Extras E>
void blend_lists(const BlendArgs& args, const TileFrame& frame, std::size_t tile, TileState& state) {
  Chunk chunk;
  const std::uint32_t begin = args.tile_begin[tile];
  const std::uint32_t end = args.tile_begin[tile + 1];
  std::uint32_t at = begin;
  const F limit = set1(args.transmittance_min);
  std::uint32_t live = live_blocks(state, limit);
  while (at < end && live != 0) {
    const int n = end - at < kChunk ? static_cast<int>(end - at) : kChunk;
    load_chunk<C>(args, frame, args.pairs + at, n, E.plane, chunk);
    for (std::uint32_t next = at + kChunk; next < at + 2 * kChunk && next < end; ++next) {
      __builtin_prefetch(args.records + args.pairs[next].id);
    }
    block_masks(chunk.ellipses, n, chunk.masks);
    for (int j = 0; j < n; ++j) {
      chunk.masks[j] &= live;
      args.masks[at + static_cast<std::uint32_t>(j)] = chunk.masks[j];
    }
    for (int j = n; j < kChunk; ++j) {
      chunk.masks[j] = 0;
    }
    transpose_masks(chunk.masks, chunk.columns);
    for (std::uint32_t left = live; left != 0; left &= left - 1) {
      const int block = __builtin_ctz(left);
      const std::uint64_t members = chunk.columns[block];
      if (members != 0) {
        for (int part = 0; part < kParts; ++part) {
          blend_block<C, E>(chunk, members, static_cast<std::size_t>(block * kBlockPixels + part * W), limit, state);
        }
      }
    }
    live = live_blocks(state, limit);
    at += static_cast<std::uint32_t>(n);
  }
  args.tile_done[tile] = at - begin;
}

void write_tile(const BlendArgs& args, const TileFrame& frame, const TileState& state) {
  const ChannelPass& pass = *args.pass;
  for (int y = 0; y < frame.height; ++y) {
    const std::size_t line = static_cast<std::size_t>(frame.y0 + y) * static_cast<std::size_t>(args.view.width) +
                             static_cast<std::size_t>(frame.x0);
    for (int x = 0; x < frame.width; ++x) {
      const int i = pixel_index(x, y);
      const float t = state.transmittance[i];
      float* to = args.out_colors + (line + static_cast<std::size_t>(x)) * static_cast<std::size_t>(args.out_channels);
      int c = 0;
      if (pass.depth_first) {
        const float divisor = state.weights[i] > kExpectedDepthMin ? state.weights[i] : kExpectedDepthMin;
        to[pass.column[0]] = args.depth == DepthMode::expected ? state.channels[0][i] / divisor : state.channels[0][i];
        c = 1;
      }
      for (; c < pass.count; ++c) {
        const float behind = args.background != nullptr ? t * args.background[c] : 0.0F;
        to[pass.column[c]] = state.channels[c][i] + behind;
      }
      if (args.write_alphas) {
        args.out_alphas[line + static_cast<std::size_t>(x)] = 1.0F - t;
      }
    }
  }
}

template <int C>
void blend_channels(const BlendArgs& args, const TileFrame& frame, std::size_t tile, TileState& state) {
  start(args, frame, C, state);
  const bool depth = args.pass->depth_first;
  const bool expected = depth && args.depth == DepthMode::expected;
  if (depth && args.plane_depth) {
    constexpr int kRoom = C < kRecordChannels ? C : 1;  // such a pass leaves two channels to the slopes
    if (expected) {
      blend_lists<kRoom, Extras{true, true}>(args, frame, tile, state);
    } else {
      blend_lists<kRoom, Extras{true, false}>(args, frame, tile, state);
    }
  } else if (expected) {
    blend_lists<C, Extras{false, true}>(args, frame, tile, state);
  } else {
    blend_lists<C, Extras{false, false}>(args, frame, tile, state);
  }
  write_tile(args, frame, state);
  float* saved = args.final_state + tile * kFinalSize;
  std::memcpy(saved, state.transmittance, sizeof(state.transmittance));
  std::memcpy(saved + kPlane, state.channels, C * sizeof(state.channels[0]));
  if (expected) {
    std::memcpy(saved + kWeightPlane * kPlane, state.weights, sizeof(state.weights));
  }
}

}  // namespace

void blend(const BlendArgs& args, std::size_t tile) {
  TileState state;
  const TileFrame frame = tile_frame(args.view, args.columns, tile);
  switch (args.pass->count) {  // the channels of a record beyond the pass's are zero
    case 1:
      return blend_channels<1>(args, frame, tile, state);
    case 2:
    case 3:
      return blend_channels<3>(args, frame, tile, state);
    case 4:
      return blend_channels<4>(args, frame, tile, state);
    case 5:
    case 6:
      return blend_channels<6>(args, frame, tile, state);
    default:
      return blend_channels<8>(args, frame, tile, state);
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
