// SPDX-License-Identifier: Apache-2.0
// Gradient of surfel_blend(), as blend_backward.cpp: front to back with each pixel's transmittance and the rest R of
// the weights' gradients.
//
// Distortion is 2 sum_i w_i |m_i A_i - B_i| with A_i, B_i the sums of w_j and w_j m_j over j < i. With the signs s_i
// of its terms fixed, its gradient to w_i is 2 (|m_i A_i - B_i| + sum_{j>i} s_j w_j (m_j - m_i)). That to m_i is 2
// w_i (s_i A_i - sum_{j>i} s_j w_j). It is of degree 2 in the weights: R counts it twice (Euler).
#include "entry.hpp"
#include "surfel.hpp"
#include "walk.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

struct TileGradient {
  alignas(64) float through[kTilePixels];  // see advance()
  alignas(64) float rest[kTilePixels];
  alignas(64) float depth[kTilePixels];    // gradient to the weighted sum of depths
  alignas(64) float median[kTilePixels], median_place[kTilePixels];
  alignas(64) float normal[3][kTilePixels];
  alignas(64) float color[kMaxSurfelChannels][kTilePixels];
  alignas(64) float distortion[kTilePixels];
  alignas(64) float weights[kTilePixels], moment[kTilePixels];     // A_i, B_i
  alignas(64) float signs[kTilePixels], sign_depths[kTilePixels];  // sums over j > i of s_j w_j and s_j w_j m_j
};

void load_pixel(const SurfelBlendBackwardArgs& args, std::size_t pixel, int i, const float* saved,
                TileGradient& state) {
  const SurfelBlendArgs& f = args.forward;
  const auto plane = [&](int p) { return saved[static_cast<std::size_t>(p) * kPlane + static_cast<std::size_t>(i)]; };
  const float t = plane(kPlaneTransmittance);
  const bool has_depth = f.options.depth != DepthMode::none;
  const std::size_t columns = static_cast<std::size_t>(f.channels) + (has_depth ? 1U : 0U);
  float grad_t = args.alphas != nullptr ? -args.alphas[pixel] : 0.0F;
  float rest = 0.0F;
  for (int c = 0; c < f.channels; ++c) {
    const float g = args.colors != nullptr ? args.colors[pixel * columns + static_cast<std::size_t>(c)] : 0.0F;
    grad_t += f.background != nullptr ? f.background[c] * g : 0.0F;
    rest += g * plane(kPlaneColor + c);
    state.color[c][i] = g;
  }
  float depth = has_depth && args.colors != nullptr ? args.colors[pixel * columns + columns - 1] : 0.0F;
  if (f.options.depth == DepthMode::expected) {
    const float covered = plane(kPlaneWeights);
    const bool divided = covered > kExpectedDepthMin;
    depth /= divided ? covered : kExpectedDepthMin;
    grad_t += divided ? depth * plane(kPlaneDepth) / covered : 0.0F;
  }
  state.depth[i] = depth;
  rest += depth * plane(kPlaneDepth);
  for (int k = 0; k < 3; ++k) {
    const float g = args.normals != nullptr ? args.normals[3 * pixel + static_cast<std::size_t>(k)] : 0.0F;
    state.normal[k][i] = g;
    rest += g * plane(kPlaneNormal + k);
  }
  state.median[i] = args.median != nullptr ? args.median[pixel] : 0.0F;
  state.median_place[i] = plane(kPlaneMedian);
  if (f.options.distortion) {
    const float g = args.distortion != nullptr ? args.distortion[pixel] : 0.0F;
    state.distortion[i] = 2.0F * g;
    rest += 2.0F * g * plane(kPlaneDistortion);
    state.signs[i] = plane(kPlaneSign);
    state.sign_depths[i] = plane(kPlaneSignDepth);
  }
  state.through[i] = 1.0F;
  state.rest[i] = rest + grad_t * t;
}

void load_tile(const SurfelBlendBackwardArgs& args, const TileFrame& frame, const float* saved, TileGradient& state) {
  std::memset(&state, 0, sizeof(state));
  for (int y = 0; y < frame.height; ++y) {
    const std::size_t line =
        static_cast<std::size_t>(frame.y0 + y) * static_cast<std::size_t>(args.forward.view.width) +
        static_cast<std::size_t>(frame.x0);
    for (int x = 0; x < frame.width; ++x) {
      load_pixel(args, line + static_cast<std::size_t>(x), pixel_index(x, y), saved, state);
    }
  }
}

// Gradient to the weight (`along`) and, through all but the weight, to the depth of the surfel's hit.
struct Along {
  F weight, depth;
};

template <int C, bool Distort>
SB_INLINE Along along_at(const float* row, const SurfelHit& hit, F weight, M median, std::size_t first,
                         TileGradient& state) {
  const F grad_depth = load(state.depth + first);
  Along out;
  out.weight = hit.depth * grad_depth;
  out.depth = fma(weight, grad_depth, zero_unless(median, load(state.median + first)));
#pragma GCC unroll 8
  for (int c = 0; c < C; ++c) {
    out.weight = fma(set1(row[kRowColor + c]), load(state.color[c] + first), out.weight);
  }
  for (int i = 0; i < 3; ++i) {
    out.weight = fma(set1(row[kRowNormal + i]), load(state.normal[i] + first), out.weight);
  }
  if (Distort) {
    const F weights = load(state.weights + first), moment = load(state.moment + first);
    const Lag lag = lag_at(hit.depth, weights, moment);
    const F signed_weight = weight * lag.sign;
    const F signs = load(state.signs + first) - signed_weight;
    const F sign_depths = fnma(signed_weight, hit.depth, load(state.sign_depths + first));
    const F g = load(state.distortion + first);
    out.weight = fma(g, fma(lag.sign, lag.lag, fnma(hit.depth, signs, sign_depths)), out.weight);
    out.depth = fma(g * weight, fms(lag.sign, weights, signs), out.depth);
    store(state.signs + first, signs);
    store(state.sign_depths + first, sign_depths);
    store(state.weights + first, weights + weight);
    store(state.moment + first, fma(weight, hit.depth, moment));
  }
  return out;
}

SB_INLINE void add_geometry(const SurfelHit& hit, F v, F depth, F (&acc)[16]) {
  const F scaled = zero_unless(hit.on_disc, hit.inverse);
  const F at = zero_unless(hit.on_disc, v) * scaled;
  const F gu = -(at * zero_unless(hit.on_disc, hit.u));
  const F gv = -(at * zero_unless(hit.on_disc, hit.v));
  const F hit_depth = zero_unless(hit.on_disc, depth) * scaled;
  const F gd = fms(at, zero_unless(hit.on_disc, hit.disc), hit_depth * hit.depth);
  acc[kSumAlpha] = acc[kSumAlpha] + v;
  acc[kSumU] = fma(gu, hit.dx, acc[kSumU]);
  acc[kSumU + 1] = fma(gu, hit.dy, acc[kSumU + 1]);
  acc[kSumU + 2] = acc[kSumU + 2] + gu;
  acc[kSumV] = fma(gv, hit.dx, acc[kSumV]);
  acc[kSumV + 1] = fma(gv, hit.dy, acc[kSumV + 1]);
  acc[kSumV + 2] = acc[kSumV + 2] + gv;
  acc[kSumD] = fma(gd, hit.dx, acc[kSumD]);
  acc[kSumD + 1] = fma(gd, hit.dy, acc[kSumD + 1]);
  acc[kSumD + 2] = acc[kSumD + 2] + gd;
  acc[kSumHitDepth] = acc[kSumHitDepth] + hit_depth;
  const F zero = set1(0.0F);
  acc[kSumCenterDepth] = acc[kSumCenterDepth] + select(hit.on_disc, zero, depth);
  const F point = select(hit.on_disc, zero, v);
  acc[kSumPointX] = fma(point, hit.dx, acc[kSumPointX]);
  acc[kSumPointY] = fma(point, hit.dy, acc[kSumPointY]);
}

template <int C, bool Distort, bool Sum>
SB_INLINE void sum_pair(const float* row, F near, std::int32_t place, std::uint32_t mask, TileGradient& state,
                        float* slot) {
  F acc[16], channels[16];
#pragma GCC unroll 16
  for (int i = 0; i < 16; ++i) {
    acc[i] = channels[i] = set1(0.0F);
  }
  const I own = set1(place);
  each_part_of(mask, [&](int, std::size_t first) SB_INLINE_LAMBDA {
    const SurfelHit hit = hit_at(load(kCenters.x + first), load(kCenters.y + first), row, near);
    F through = load(state.through + first);
    const Step step = advance(hit.alpha, through, set1(kTransmittanceMin));
    const M median = bit_cast_int(load(state.median_place + first)) == own;
    const Along along = along_at<C, Distort>(row, hit, step.weight, median, first, state);
    const F rest = fnma(step.weight, along.weight, load(state.rest + first));
    store(state.through + first, through);
    store(state.rest + first, rest);
    const F v = pull_back_alpha(hit.alpha, step, along.weight, rest);
    add_geometry(hit, v, along.depth, acc);
    if (Sum) {
      for (int i = 0; i < 3; ++i) {
        channels[i] = fma(step.weight, load(state.normal[i] + first), channels[i]);
      }
#pragma GCC unroll 8
      for (int c = 0; c < C; ++c) {
        channels[3 + c] = fma(step.weight, load(state.color[c] + first), channels[3 + c]);
      }
    }
  });
  store_sums<kSurfelGeometrySums>(slot, acc);
  if (Sum) {
    store_sums<3 + C>(slot + kSumNormal, channels);
  }
}

template <int C, bool Distort, bool Sum>
void backward_lists(const SurfelBlendBackwardArgs& args, const TileFrame& frame, std::size_t tile,
                    TileGradient& state) {
  const SurfelBlendArgs& f = args.forward;
  const F near = set1(f.options.near_plane);
  const std::uint32_t begin = f.tile_begin[tile];
  alignas(64) float row[kSurfelRow];
  each_slot<kSurfelSlot>(args, tile, [&](std::uint32_t at, std::uint32_t mask, float* slot) SB_INLINE_LAMBDA {
    localize<C>(f.records[f.pairs[at].id], frame, row);
    sum_pair<C, Distort, Sum>(row, near, static_cast<std::int32_t>(at - begin), mask, state, slot);
  });
}

}  // namespace

void surfel_blend_backward(const SurfelBlendBackwardArgs& args, std::size_t tile) {
  TileGradient state;
  const TileFrame frame = tile_frame(args.forward.view, args.forward.columns, tile);
  load_tile(args, frame, args.forward.final_state + tile * kSurfelPlanes * kPlane, state);
  with_surfel_channels(args.forward.channels, [&](auto channels) {
    with_flag(args.forward.options.distortion && args.distortion != nullptr, [&](auto distort) {
      with_flag(args.sum_channels,
                [&](auto sum) { backward_lists<channels, distort, sum>(args, frame, tile, state); });
    });
  });
}

}  // namespace splatbot::SPLATBOT_KERNELS
