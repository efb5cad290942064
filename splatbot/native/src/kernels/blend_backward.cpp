// SPDX-License-Identifier: Apache-2.0
// Gradient of blend(), Gaussian by Gaussian, front to back. T is each pixel's transmittance. The rest R is the sum of
// (channels . gradient) x weight over the Gaussians still to blend, plus T_final x gradient of T_final. Then
//   d loss / d alpha = T (channels . gradient) - R_after / (1 - alpha),
// without a division by T. Order and masks are those of the forward pass. The sums of one (Gaussian, tile) pair
// go to their own slot. Threads share no sums, and the result does not depend on their number.
#include "entry.hpp"
#include "walk.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

struct TileGradient {
  alignas(64) float through[kTilePixels];  // see advance()
  alignas(64) float rest[kTilePixels];
  alignas(64) float gradient[kRecordChannels][kTilePixels];
};

void load_gradients(const BlendBackwardArgs& args, const TileFrame& frame, int channels, TileGradient& state) {
  const BlendArgs& f = args.forward;
  const auto width = static_cast<std::size_t>(f.view.width);
  const int given = args.grad_colors != nullptr ? f.pass->count : 0;
  const bool whole = whole_tile(frame);
  for (int c = whole ? given : 0; c < channels; ++c) {
    std::memset(state.gradient[c], 0, sizeof(state.gradient[c]));
  }
  if (given != 0) {
    float* planes[kRecordChannels];
    for (int c = 0; c < given; ++c) {
      planes[c] = state.gradient[c];
    }
    copy_in(frame, width, args.grad_colors, f.out_channels, f.pass->column.data(), given, planes);
  }
  if (!whole || args.grad_alphas == nullptr) {
    std::memset(state.rest, 0, sizeof(state.rest));
  }
  if (args.grad_alphas != nullptr) {
    float* alphas[1] = {state.rest};
    const int column[1] = {0};
    copy_in(frame, width, args.grad_alphas, 1, column, 1, alphas);
  }
}

// Gradients to the sums that blend() had before the background was added and expected depth was divided.
void load_tile(const BlendBackwardArgs& args, const TileFrame& frame, int channels, const float* saved,
               TileGradient& state) {
  const ChannelPass& pass = *args.forward.pass;
  const float* background = args.forward.background;
  load_gradients(args, frame, channels, state);
  open_pixels(args.forward, frame, state.through);
  for (std::size_t i = 0; i < kPlane; i += W) {
    F grad_t = -load(state.rest + i);  // of alphas
    F rest = set1(0.0F);
    for (int c = 0; c < pass.count; ++c) {
      F g = load(state.gradient[c] + i);
      const F sum = load(saved + (1 + static_cast<std::size_t>(c)) * kPlane + i);
      if (c == 0 && pass.depth_first) {
        if (args.forward.depth == DepthMode::expected) {
          const F covered = load(saved + kWeightPlane * kPlane + i);
          const M divided = covered > set1(kExpectedDepthMin);
          g = g / select(divided, covered, set1(kExpectedDepthMin));
          grad_t = grad_t + zero_unless(divided, g * sum / max(covered, set1(kExpectedDepthMin)));
          store(state.gradient[0] + i, g);
        }
      } else if (background != nullptr) {
        grad_t = grad_t + set1(background[c]) * g;
      }
      rest = rest + sum * g;
    }
    store(state.rest + i, rest + grad_t * load(saved + i));
  }
}

SB_INLINE F abs(F a) { return max(a, -a); }

// Sums of each pair in addition to the channels' gradients.
enum class Sums { none, moments, absolute };

// Sums: 1, u, w, uu, uw, ww times d loss / d log(alpha). Weight times gradient follows for the first S channels. If
// absolute, the absolute gradients of the centre in x (less a factor) and y follow. Without moments the gradient to
// alpha is not needed.
template <int C, int S, bool Plane, Sums Kind>
SB_INLINE void sum_pair(const Record& record, const Lines& lines, const float* channels, const PlaneDepth& plane,
                        std::uint32_t mask, F limit, TileGradient& state, float* slot) {
  F acc[16];
#pragma GCC unroll 16
  for (int i = 0; i < 16; ++i) {
    acc[i] = set1(0.0F);
  }
  each_part_of(mask, [&](int block, std::size_t first) SB_INLINE_LAMBDA {
    const AlphaAt a = alpha_at(lines, block, first);
    F through = load(state.through + first);
    const Step step = advance(a, through, limit);
    F along = set1(0.0F);
#pragma GCC unroll 8
    for (int c = 0; c < C; ++c) {
      const F g = load(state.gradient[c] + first);
      F value = set1(channels[c]);
      if (Plane && c == 0) {
        const F x = load(kCenters.x + first), y = load(kCenters.y + first);
        value = fma(set1(plane.slope_x), x, fma(set1(plane.slope_y), y, set1(plane.corner)));
      }
      if (Kind != Sums::none) {
        along = fma(value, g, along);
      }
      if (c < S) {
        acc[kMoments + c] = fma(step.weight, g, acc[kMoments + c]);
      }
    }
    store(state.through + first, through);
    if (Kind == Sums::none) {
      return;
    }
    const F rest = fnma(step.weight, along, load(state.rest + first));
    store(state.rest + first, rest);
    const F v = pull_back_alpha(a, step, along, rest);
    const F vu = v * a.u;
    const F w = load_quad(lines.w + first_line(block));
    const F vw = v * w;
    acc[0] = acc[0] + v;
    acc[1] = acc[1] + vu;
    acc[2] = acc[2] + vw;
    acc[3] = fma(vu, a.u, acc[3]);
    acc[4] = fma(vu, w, acc[4]);
    acc[5] = fma(vw, w, acc[5]);
    if (Kind == Sums::absolute) {
      acc[kAbsolute] = acc[kAbsolute] + abs(vu);
      acc[kAbsolute + 1] = acc[kAbsolute + 1] + abs(fma(set1(record.l21), vu, set1(record.l22) * vw));
    }
  });
  store_sums<Kind == Sums::absolute ? kSlot : kMoments + S>(slot, acc);
}

template <int C, int S, bool Plane, Sums Kind>
void backward_lists(const BlendBackwardArgs& args, const TileFrame& frame, std::size_t tile, TileGradient& state) {
  const BlendArgs& f = args.forward;
  const F limit = set1(f.transmittance_min);
  each_slot<kSlot>(args, tile, [&](std::uint32_t at, std::uint32_t mask, float* slot) SB_INLINE_LAMBDA {
    const std::size_t id = f.pairs[at].id;
    const Record& record = f.records[id];
    Lines lines;
    localize(record, frame, lines);
    const float* channels = f.channels + id * f.channel_stride;
    const PlaneDepth plane = Plane ? plane_depth(record, channels, frame) : PlaneDepth{};
    sum_pair<C, S, Plane, Kind>(record, lines, channels, plane, mask, limit, state, slot);
  });
}

template <int C, bool Plane>
void backward_sums(const BlendBackwardArgs& args, const TileFrame& frame, std::size_t tile, TileGradient& state) {
  if (args.absolute) {  // for densification, which wants all gradients anyway
    backward_lists<C, C, Plane, Sums::absolute>(args, frame, tile, state);
  } else if (!args.geometry) {
    backward_lists<C, C, Plane, Sums::none>(args, frame, tile, state);
  } else if (args.channel_sums == 0) {
    backward_lists<C, 0, Plane, Sums::moments>(args, frame, tile, state);
  } else if (args.channel_sums == 1) {
    backward_lists<C, 1, Plane, Sums::moments>(args, frame, tile, state);
  } else {
    backward_lists<C, C, Plane, Sums::moments>(args, frame, tile, state);
  }
}

template <int C>
void backward_channels(const BlendBackwardArgs& args, const TileFrame& frame, std::size_t tile, TileGradient& state) {
  load_tile(args, frame, C, args.forward.final_state + tile * kFinalSize, state);
  if (args.forward.plane_depth && args.forward.pass->depth_first) {
    backward_sums<C < kRecordChannels ? C : 1, true>(args, frame, tile, state);
  } else {
    backward_sums<C, false>(args, frame, tile, state);
  }
}

}  // namespace

void blend_backward(const BlendBackwardArgs& args, std::size_t tile) {
  TileGradient state;
  const TileFrame frame = tile_frame(args.forward.view, args.forward.columns, tile);
  with_channels(args.forward.pass->count,
                [&](auto channels) { backward_channels<channels>(args, frame, tile, state); });
}

}  // namespace splatbot::SPLATBOT_KERNELS
