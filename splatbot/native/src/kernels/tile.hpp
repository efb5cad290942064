// SPDX-License-Identifier: Apache-2.0
// Code that the two blend passes share: a tile's geometry and the alpha of a Gaussian in W of its pixels.
#pragma once

#include "simd.hpp"
#include "splatbot/kernels.hpp"

namespace splatbot::SPLATBOT_KERNELS {

inline constexpr int kParts = kBlockPixels / W;  // vectors to a block
inline constexpr std::size_t kPlane = kTilePixels;
inline constexpr std::size_t kFinalSize = kFinalPlanes * kPlane;  // of one tile

struct TileFrame {
  int x0, y0;          // first pixel
  int width, height;  // pixels within the image
};

SB_INLINE TileFrame tile_frame(const View& view, int columns, std::size_t tile) {
  const int x0 = static_cast<int>(tile % static_cast<std::size_t>(columns)) * kTileWidth;
  const int y0 = static_cast<int>(tile / static_cast<std::size_t>(columns)) * kTileHeight;
  const int width = view.width - x0 < kTileWidth ? view.width - x0 : kTileWidth;
  const int height = view.height - y0 < kTileHeight ? view.height - y0 : kTileHeight;
  return {x0, y0, width, height};
}

SB_INLINE bool whole_tile(const TileFrame& frame) {
  return frame.width == kTileWidth && frame.height == kTileHeight;
}

// True if a pixel of the image is requested.
SB_INLINE bool kept(const BlendArgs& args, int x, int y) {
  return args.mask == nullptr || args.mask[(y / args.mask_size) * args.mask_columns + x / args.mask_size] != 0;
}

// Pixel centres of a tile relative to its corner, in the order of pixel_index, and those of its lines.
struct Centers {
  alignas(64) float x[kTilePixels], y[kTilePixels], line[kTileHeight];

  constexpr Centers() : x{}, y{}, line{} {
    for (int i = 0; i < kTilePixels; ++i) {
      const int block = i / kBlockPixels, lane = i % kBlockPixels;
      x[i] = static_cast<float>(block % kBlockColumns * kBlock + lane / kBlock) + 0.5F;
      y[i] = static_cast<float>(block / kBlockColumns * kBlock + lane % kBlock) + 0.5F;
    }
    for (int i = 0; i < kTileHeight; ++i) {
      line[i] = static_cast<float>(i) + 0.5F;
    }
  }
};
inline constexpr Centers kCenters{};

// The lines of pixels that a block's part crosses begin here in arrays over a tile's lines.
SB_INLINE int first_line(int block) { return block / kBlockColumns * kBlock; }

// A Gaussian along a tile's lines of pixels: u at the tile's left edge, w, and their rest of log2(alpha).
struct Lines {
  alignas(64) float u[kTileHeight], w[kTileHeight], rest[kTileHeight];
  float l11;
};

SB_INLINE void localize(const Record& record, const TileFrame& frame, float* u, float* w, float* rest) {
  const float dx = static_cast<float>(frame.x0) - record.mx;
  const float dy = static_cast<float>(frame.y0) - record.my;
  const F u0 = set1(record.l11 * dx + record.l21 * dy), w0 = set1(record.l22 * dy);
  const F l21 = set1(record.l21), l22 = set1(record.l22), lo = set1(record.lo);
#pragma GCC unroll 4
  for (int i = 0; i < kTileHeight; i += W) {
    const F y = load(kCenters.line + i);
    const F across = fma(l22, y, w0);
    store(u + i, fma(l21, y, u0));
    store(rest + i, fnma(across, across, lo));
    if (w != nullptr) {
      store(w + i, across);
    }
  }
}

SB_INLINE void localize(const Record& record, const TileFrame& frame, Lines& lines) {
  localize(record, frame, lines.u, lines.w, lines.rest);
  lines.l11 = record.l11;
}

// Depth over a Gaussian's footprint, from the tile's corner.
struct PlaneDepth {
  float slope_x, slope_y, corner;
};

SB_INLINE PlaneDepth plane_depth(const Record& record, const float* channels, const TileFrame& frame) {
  const float sx = channels[kRecordChannels - 2], sy = channels[kRecordChannels - 1];
  return {sx, sy, channels[0] - sx * (record.mx - static_cast<float>(frame.x0)) -
                      sy * (record.my - static_cast<float>(frame.y0))};
}

struct Alpha {
  F power;     // opacity x falloff, before the cap
  F alpha;     // 0 below 1/255
  F left;      // 1 - alpha
};

// Both passes go through here, so that they decide alike which pixel a Gaussian counts in. Where q, the log2 of
// opacity x falloff, is below that of 1/255, power means nothing.
SB_INLINE Alpha alpha_of(F q) {
  Alpha a;
  a.power = exp2(q);
  a.alpha = min_zero_unless(q >= set1(kLog2AlphaMin), a.power, set1(kAlphaMax));
  a.left = set1(1.0F) - a.alpha;
  return a;
}

struct AlphaAt : Alpha {
  F u;
};

// At pixels of four lines, of which u and rest are given (see Lines).
SB_INLINE AlphaAt alpha_at(F x, F l11, const float* u, const float* rest) {
  const F here = fma(l11, x, load_quad(u));
  return {alpha_of(fnma(here, here, load_quad(rest))), here};
}

SB_INLINE AlphaAt alpha_at(const Lines& lines, int block, std::size_t first) {
  const int line = first_line(block);
  return alpha_at(load(kCenters.x + first), set1(lines.l11), lines.u + line, lines.rest + line);
}

struct Step {
  F weight;  // alpha x transmittance, 0 in pixels that are or have just been closed
  M open;
};

// `through` is the product of (1 - alpha) over all Gaussians so far, including those behind the one that closed the
// pixel (0 outside the image). It only falls, so it is above the limit as long as the pixel is open. The chain of
// dependent steps is one multiplication long.
SB_INLINE Step advance(const Alpha& a, F& through, F limit) {
  const F next = through * a.left;
  const M open = next > limit;
  const F weight = mul_zero_unless(open, a.alpha, through);
  through = next;
  return {weight, open};
}

}  // namespace splatbot::SPLATBOT_KERNELS
