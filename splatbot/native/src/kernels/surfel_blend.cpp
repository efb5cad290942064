// SPDX-License-Identifier: Apache-2.0
// Front-to-back blending of one tile of surfels, as in blend.cpp.
#include "entry.hpp"
#include "surfel.hpp"
#include "walk.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

// Ellipses of one chunk, field by field.
struct ChunkEllipses {
  alignas(64) float cx[kChunk], cy[kChunk];  // centre, from the tile's corner
  alignas(64) float l11[kChunk], l21[kChunk], l22[kChunk], reach[kChunk], lean[kChunk];
};

struct Chunk {
  alignas(64) float rows[kChunk][kSurfelRow];
  ChunkEllipses ellipses, circles;
  bool any_circle;
  std::uint64_t unbounded;
  std::uint32_t masks[kChunk], circle_masks[kChunk];
  std::uint64_t columns[kBlocks];
};

struct TileState {
  alignas(64) float through[kTilePixels];  // see advance()
  alignas(64) float planes[kSurfelPlanes][kTilePixels];
  alignas(64) float median[kTilePixels];   // depth
  alignas(64) float moment[kTilePixels];   // of distortion: weight x depth so far
};

void start(const TileFrame& frame, TileState& state) {
  std::memset(state.planes, 0, sizeof(state.planes));
  std::memset(state.median, 0, sizeof(state.median));
  std::memset(state.moment, 0, sizeof(state.moment));
  const std::int32_t none = -1;
  for (int i = 0; i < kTilePixels; ++i) {
    const bool inside =
        kCenters.x[i] < static_cast<float>(frame.width) && kCenters.y[i] < static_cast<float>(frame.height);
    state.through[i] = inside ? 1.0F : 0.0F;
    state.planes[kPlaneTransmittance][i] = 1.0F;
    std::memcpy(&state.planes[kPlaneMedian][i], &none, sizeof(none));
  }
}

SB_INLINE void set_ellipse(ChunkEllipses& e, int j, float cx, float cy, float l11, float l21, float l22, float reach,
                           float lean) {
  e.cx[j] = cx;
  e.cy[j] = cy;
  e.l11[j] = l11;
  e.l21[j] = l21;
  e.l22[j] = l22;
  e.reach[j] = reach;
  e.lean[j] = lean;
}

template <int C>
SB_INLINE void load_chunk(const SurfelBlendArgs& args, const TileFrame& frame, const Pair* pairs, int n,
                          Chunk& chunk) {
  const auto x0 = static_cast<float>(frame.x0), y0 = static_cast<float>(frame.y0);
  chunk.unbounded = 0;
  chunk.any_circle = false;
  for (int j = 0; j < n; ++j) {
    const SurfelRecord& r = args.records[pairs[j].id];
    localize<C>(r, frame, chunk.rows[j]);
    const bool bounded = r.l11 > 0.0F;
    chunk.unbounded |= static_cast<std::uint64_t>(!bounded) << j;
    chunk.any_circle |= r.circle > 0.0F;
    set_ellipse(chunk.ellipses, j, bounded ? r.ex - x0 : 0.0F, bounded ? r.ey - y0 : 0.0F, bounded ? r.l11 : 1.0F,
                bounded ? r.l21 : 0.0F, bounded ? r.l22 : 1.0F, 1.0F, bounded ? r.lean : 0.0F);
    // A circle of no reach is put out of the way: block_masks() widens it by a margin.
    set_ellipse(chunk.circles, j, r.circle > 0.0F ? r.mx - x0 + r.part_x : -100.0F, r.my - y0 + r.part_y, 1.0F, 0.0F, 1.0F, r.circle, 0.0F);
  }
  const int padded = (n + W - 1) / W * W;
  for (int j = n; j < padded; ++j) {  // masked out later; any finite ellipse will do
    set_ellipse(chunk.ellipses, j, 0.0F, 0.0F, 1.0F, 0.0F, 1.0F, 0.0F, 0.0F);
    set_ellipse(chunk.circles, j, 0.0F, 0.0F, 1.0F, 0.0F, 1.0F, 0.0F, 0.0F);
  }
}

SB_INLINE void find_masks_of(const ChunkEllipses& e, int n, std::uint32_t* masks) {
  for (int j = 0; j < n; j += W) {
    store(masks + j, block_masks({load(e.cx + j), load(e.cy + j), load(e.l11 + j), load(e.l21 + j), load(e.l22 + j),
                                  load(e.reach + j), load(e.lean + j)}));
  }
}

// Masks of the live blocks that n surfels reach, 0 beyond.
SB_INLINE void find_masks(Chunk& chunk, int n, std::uint32_t live) {
  find_masks_of(chunk.ellipses, n, chunk.masks);
  if (chunk.any_circle) {
    find_masks_of(chunk.circles, n, chunk.circle_masks);
    for (int j = 0; j < n; ++j) {
      chunk.masks[j] |= chunk.circle_masks[j];
    }
  }
  for (std::uint64_t left = chunk.unbounded; left != 0; left &= left - 1) {
    chunk.masks[__builtin_ctzll(left)] = ~0U;
  }
  for (int j = 0; j < kChunk; ++j) {
    chunk.masks[j] = j < n ? chunk.masks[j] & live : 0;
  }
}

template <int C, bool Distort>
SB_INLINE void blend_block(const Chunk& chunk, std::uint64_t members, int place, F near, std::size_t first,
                           TileState& state) {
  const F x = load(kCenters.x + first), y = load(kCenters.y + first);
  const auto plane = [&](int p) { return load(state.planes[p] + first); };
  const auto keep = [&](int p, F value) { store(state.planes[p] + first, value); };
  F through = load(state.through + first);
  F transmittance = plane(kPlaneTransmittance), weights = plane(kPlaneWeights), depth = plane(kPlaneDepth);
  F normal[3], sum[C > 0 ? C : 1];
  for (int i = 0; i < 3; ++i) {
    normal[i] = plane(kPlaneNormal + i);
  }
#pragma GCC unroll 8
  for (int c = 0; c < C; ++c) {
    sum[c] = plane(kPlaneColor + c);
  }
  F median_place = plane(kPlaneMedian), median = load(state.median + first);
  F distortion = plane(kPlaneDistortion), signs = plane(kPlaneSign), sign_depths = plane(kPlaneSignDepth);
  F moment = load(state.moment + first);
  while (members != 0) {
    const int j = __builtin_ctzll(members);
    const float* row = chunk.rows[j];
    members &= members - 1;
    const SurfelHit hit = hit_at(x, y, row, near);
    const F before = through;
    const Step step = advance(hit.alpha, through, set1(kTransmittanceMin));
    transmittance = select(step.open, through, transmittance);
    const M candidate = median_candidate(hit, step, before);
    median = select(candidate, hit.depth, median);
    median_place = select(candidate, bit_cast_float(set1(place + j)), median_place);
    if (Distort) {
      const Lag lag = lag_at(hit.depth, weights, moment);
      const F signed_weight = step.weight * lag.sign;
      distortion = fma(signed_weight + signed_weight, lag.lag, distortion);
      signs = signs + signed_weight;
      sign_depths = fma(signed_weight, hit.depth, sign_depths);
      moment = fma(step.weight, hit.depth, moment);
    }
    weights = weights + step.weight;
    depth = fma(step.weight, hit.depth, depth);
    for (int i = 0; i < 3; ++i) {
      normal[i] = fma(step.weight, set1(row[kRowNormal + i]), normal[i]);
    }
#pragma GCC unroll 8
    for (int c = 0; c < C; ++c) {
      sum[c] = fma(step.weight, set1(row[kRowColor + c]), sum[c]);
    }
  }
  store(state.through + first, through);
  keep(kPlaneTransmittance, transmittance);
  keep(kPlaneWeights, weights);
  keep(kPlaneDepth, depth);
  for (int i = 0; i < 3; ++i) {
    keep(kPlaneNormal + i, normal[i]);
  }
#pragma GCC unroll 8
  for (int c = 0; c < C; ++c) {
    keep(kPlaneColor + c, sum[c]);
  }
  keep(kPlaneMedian, median_place);
  store(state.median + first, median);
  if (Distort) {
    keep(kPlaneDistortion, distortion);
    keep(kPlaneSign, signs);
    keep(kPlaneSignDepth, sign_depths);
    store(state.moment + first, moment);
  }
}

template <int C, bool Distort>
void blend_lists(const SurfelBlendArgs& args, const TileFrame& frame, std::size_t tile, TileState& state) {
  const F near = set1(args.options.near_plane);
  const std::uint32_t begin = args.tile_begin[tile];
  const auto load_pairs = [&](std::uint32_t at, int n, std::uint32_t live, Chunk& chunk) SB_INLINE_LAMBDA {
    load_chunk<C>(args, frame, args.pairs + at, n, chunk);
    find_masks(chunk, n, live);
  };
  const auto blend_part = [&](const Chunk& chunk, std::uint64_t members, std::uint32_t at, int block, int part)
                              SB_INLINE_LAMBDA {
    blend_block<C, Distort>(chunk, members, static_cast<int>(at - begin), near,
                            static_cast<std::size_t>(block * kBlockPixels + part * W), state);
  };
  blend_chunks<Chunk>(args, tile, state.through, set1(kTransmittanceMin), load_pairs, blend_part);
}

void write_tile(const SurfelBlendArgs& args, const TileFrame& frame, const TileState& state) {
  const bool has_depth = args.options.depth != DepthMode::none;
  const std::size_t columns = static_cast<std::size_t>(args.channels) + (has_depth ? 1U : 0U);
  for (int y = 0; y < frame.height; ++y) {
    const std::size_t line = static_cast<std::size_t>(frame.y0 + y) * static_cast<std::size_t>(args.view.width) +
                             static_cast<std::size_t>(frame.x0);
    for (int x = 0; x < frame.width; ++x) {
      const int i = pixel_index(x, y);
      const std::size_t pixel = line + static_cast<std::size_t>(x);
      const float t = state.planes[kPlaneTransmittance][i];
      float* to = args.colors + pixel * columns;
      for (int c = 0; c < args.channels; ++c) {
        to[c] = state.planes[kPlaneColor + c][i] + (args.background != nullptr ? t * args.background[c] : 0.0F);
      }
      if (has_depth) {
        const float weights = state.planes[kPlaneWeights][i];
        const float divisor = weights > kExpectedDepthMin ? weights : kExpectedDepthMin;
        const float depth = state.planes[kPlaneDepth][i];
        to[args.channels] = args.options.depth == DepthMode::expected ? depth / divisor : depth;
      }
      args.alphas[pixel] = 1.0F - t;
      for (int k = 0; k < 3; ++k) {
        args.normals[3 * pixel + static_cast<std::size_t>(k)] = state.planes[kPlaneNormal + k][i];
      }
      args.median[pixel] = state.median[i];
      if (args.options.distortion) {
        args.distortion[pixel] = state.planes[kPlaneDistortion][i];
      }
    }
  }
}

}  // namespace

void surfel_blend(const SurfelBlendArgs& args, std::size_t tile) {
  TileState state;
  const TileFrame frame = tile_frame(args.view, args.columns, tile);
  start(frame, state);
  with_surfel_channels(args.channels, [&](auto channels) {
    with_flag(args.options.distortion,
              [&](auto distort) { blend_lists<channels, distort>(args, frame, tile, state); });
  });
  write_tile(args, frame, state);
  std::memcpy(args.final_state + tile * kSurfelPlanes * kPlane, state.planes, sizeof(state.planes));
}

}  // namespace splatbot::SPLATBOT_KERNELS
