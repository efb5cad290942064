// SPDX-License-Identifier: Apache-2.0
// Front-to-back blending of one tile, 64 Gaussians at a time. Their block masks are found first. Then each block goes
// through the Gaussians that reach it, with its transmittance and colours in registers.
#include "entry.hpp"
#include "walk.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

// Rows of a chunk: along the tile's lines as in Lines, then l11, plane depth, channels.
constexpr int kRowU = 0;
constexpr int kRowRest = kTileHeight;
constexpr int kRowL11 = 2 * kTileHeight;
constexpr int kRowPlane = kRowL11 + 1;
constexpr int kRowChannels = kRowL11 + 4;
constexpr int kRow = kRowL11 + 16;
static_assert(kRowChannels + kRecordChannels <= kRow);

struct Chunk {
  alignas(64) float rows[kChunk][kRow];
  std::uint32_t masks[kChunk];
  std::uint64_t columns[kBlocks];
};

struct TileState {
  alignas(64) float through[kTilePixels];        // see advance()
  alignas(64) float transmittance[kTilePixels];  // transmittance behind the contributing Gaussians
  alignas(64) float channels[kRecordChannels][kTilePixels];
  alignas(64) float weights[kTilePixels];  // for expected depth, where 1 - transmittance has too few digits if small
};

// Options of a blend in addition to summing channels.
struct Extras {
  bool plane;  // depth varies over a footprint
  bool weigh;  // sum the weights
};

void start(const BlendArgs& args, const TileFrame& frame, int channels, TileState& state) {
  open_pixels(args, frame, state.through);
  for (float& transmittance : state.transmittance) {
    transmittance = 1.0F;
  }
  for (int c = 0; c < channels; ++c) {
    std::memset(state.channels[c], 0, sizeof(state.channels[c]));
  }
  std::memset(state.weights, 0, sizeof(state.weights));
}

template <int C>
SB_INLINE void load_chunk(const BlendArgs& args, const TileFrame& frame, const Pair* pairs, int n, std::uint32_t live,
                          bool slopes, Chunk& chunk) {
  for (int j = 0; j < n; ++j) {
    const Record& record = args.records[pairs[j].id];
    const float* channels = args.channels + pairs[j].id * args.channel_stride;
    float* row = chunk.rows[j];
    localize(record, frame, row + kRowU, nullptr, row + kRowRest);
    row[kRowL11] = record.l11;
    std::memcpy(row + kRowChannels, channels, C * sizeof(float));
    if (slopes) {
      const PlaneDepth plane = plane_depth(record, channels, frame);
      std::memcpy(row + kRowPlane, &plane, sizeof(plane));
    }
  }
  for (int j = 0; j < kChunk; j += W) {
    const I masks = j < n ? block_masks(load_ellipses(args.records, pairs + j, n - j, frame)) : set1(0);
    store(chunk.masks + j, masks & set1(static_cast<int>(live)));
  }
  for (int j = n; j < kChunk; ++j) {
    chunk.masks[j] = 0;
  }
}

template <int C, Extras E>
SB_INLINE void blend_block(const Chunk& chunk, std::uint64_t members, int block, int part, F limit, TileState& state) {
  const auto first = static_cast<std::size_t>(block * kBlockPixels + part * W);
  const F x = load(kCenters.x + first), y = load(kCenters.y + first);
  const float* rows = chunk.rows[0] + first_line(block);
  F through = load(state.through + first);
  F transmittance = load(state.transmittance + first);
  F sum[C];
#pragma GCC unroll 8
  for (int c = 0; c < C; ++c) {
    sum[c] = load(state.channels[c] + first);
  }
  F weights = load(state.weights + first);
  while (members != 0) {
    const int member = __builtin_ctzll(members);
    members &= members - 1;
    const float* row = chunk.rows[member];
    const float* lines = rows + member * kRow;
    const AlphaAt a = alpha_at(x, set1(row[kRowL11]), lines + kRowU, lines + kRowRest);
    const Step step = advance(a, through, limit);
    transmittance = select(step.open, through, transmittance);
#pragma GCC unroll 8
    for (int c = 0; c < C; ++c) {
      F value = set1(row[kRowChannels + c]);
      if (E.plane && c == 0) {
        value = fma(set1(row[kRowPlane]), x, fma(set1(row[kRowPlane + 1]), y, set1(row[kRowPlane + 2])));
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

template <int C, Extras E>
void blend_lists(const BlendArgs& args, const TileFrame& frame, std::size_t tile, TileState& state) {
  const F limit = set1(args.transmittance_min);
  const auto load_pairs = [&](std::uint32_t at, int n, std::uint32_t live, Chunk& chunk) SB_INLINE_LAMBDA {
    load_chunk<C>(args, frame, args.pairs + at, n, live, E.plane, chunk);
  };
  const auto blend_part = [&](const Chunk& chunk, std::uint64_t members, std::uint32_t, int block, int part)
                              SB_INLINE_LAMBDA { blend_block<C, E>(chunk, members, block, part, limit, state); };
  blend_chunks<Chunk>(args, tile, state.through, limit, load_pairs, blend_part);
}

// Converts sums to outputs: adds the background, divides depth by the weights.
void finish(const BlendArgs& args, TileState& state) {
  const ChannelPass& pass = *args.pass;
  for (std::size_t i = 0; i < kPlane; i += W) {
    const F t = load(state.transmittance + i);
    if (pass.depth_first && args.depth == DepthMode::expected) {
      const F divisor = max(load(state.weights + i), set1(kExpectedDepthMin));
      store(state.channels[0] + i, load(state.channels[0] + i) / divisor);
    }
    for (int c = pass.depth_first ? 1 : 0; c < pass.count && args.background != nullptr; ++c) {
      store(state.channels[c] + i, load(state.channels[c] + i) + t * set1(args.background[c]));
    }
    store(state.transmittance + i, set1(1.0F) - t);
  }
}

void write_tile(const BlendArgs& args, const TileFrame& frame, const TileState& state) {
  const ChannelPass& pass = *args.pass;
  const auto width = static_cast<std::size_t>(args.view.width);
  const float* planes[kRecordChannels];
  for (int c = 0; c < pass.count; ++c) {
    planes[c] = state.channels[c];
  }
  copy_out(frame, width, planes, pass.column.data(), pass.count, args.out_channels, args.out_colors);
  if (args.write_alphas) {
    const float* alphas[1] = {state.transmittance};
    const int column[1] = {0};
    copy_out(frame, width, alphas, column, 1, 1, args.out_alphas);
  }
}

SB_INLINE void expect_writes(const float* from, std::size_t floats) {
  for (std::size_t i = 0; i < floats; i += 64 / sizeof(float)) {
    __builtin_prefetch(from + i, 1);
  }
}

// Ask for the memory that a tile will be written to: it arrives while the tile is blended.
void expect_tile(const BlendArgs& args, const TileFrame& frame, std::size_t tile, int channels) {
  for (int y = 0; y < frame.height; ++y) {
    const std::size_t line = line_of(frame, static_cast<std::size_t>(args.view.width), y);
    const auto columns = static_cast<std::size_t>(args.out_channels), pixels = static_cast<std::size_t>(frame.width);
    expect_writes(args.out_colors + line * columns, pixels * columns);
    if (args.write_alphas) {
      expect_writes(args.out_alphas + line, pixels);
    }
  }
  expect_writes(args.final_state + tile * kFinalSize, static_cast<std::size_t>(1 + channels) * kPlane);
}

template <int C>
void blend_channels(const BlendArgs& args, const TileFrame& frame, std::size_t tile, TileState& state) {
  expect_tile(args, frame, tile, C);
  start(args, frame, C, state);
  const bool depth = args.pass->depth_first;
  const bool expected = depth && args.depth == DepthMode::expected;
  with_flag(expected, [&](auto weights) {
    if (depth && args.plane_depth) {
      constexpr int kRoom = C < kRecordChannels ? C : 1;  // such a pass leaves two channels to the slopes
      blend_lists<kRoom, Extras{true, weights}>(args, frame, tile, state);
    } else {
      blend_lists<C, Extras{false, weights}>(args, frame, tile, state);
    }
  });
  float* saved = args.final_state + tile * kFinalSize;
  std::memcpy(saved, state.transmittance, sizeof(state.transmittance));
  std::memcpy(saved + kPlane, state.channels, C * sizeof(state.channels[0]));
  if (expected) {
    std::memcpy(saved + kWeightPlane * kPlane, state.weights, sizeof(state.weights));
  }
  finish(args, state);
  write_tile(args, frame, state);
}

}  // namespace

void blend(const BlendArgs& args, std::size_t tile) {
  TileState state;
  const TileFrame frame = tile_frame(args.view, args.columns, tile);
  with_channels(args.pass->count, [&](auto channels) { blend_channels<channels>(args, frame, tile, state); });
}

}  // namespace splatbot::SPLATBOT_KERNELS
