// SPDX-License-Identifier: Apache-2.0
// What the two blend passes share: a tile's geometry and the alpha of a Gaussian in W of its pixels.
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

// Whether a pixel of the image is asked for.
SB_INLINE bool kept(const BlendArgs& args, int x, int y) {
  return args.mask == nullptr || args.mask[(y / args.mask_size) * args.mask_columns + x / args.mask_size] != 0;
}

// Pixels of a tile are kept block by block, 16 to a block, row by row within it.
SB_INLINE int pixel_index(int x, int y) {
  return ((y / kBlock) * kBlockColumns + x / kBlock) * kBlockPixels + (y % kBlock) * kBlock + x % kBlock;
}

// Pixel centres of a tile relative to its corner, in the order of pixel_index.
struct Centers {
  alignas(64) float x[kTilePixels], y[kTilePixels];

  constexpr Centers() : x{}, y{} {
    for (int i = 0; i < kTilePixels; ++i) {
      const int block = i / kBlockPixels, lane = i % kBlockPixels;
      x[i] = static_cast<float>(block % kBlockColumns * kBlock + lane % kBlock) + 0.5F;
      y[i] = static_cast<float>(block / kBlockColumns * kBlock + lane / kBlock) + 0.5F;
    }
  }
};
inline constexpr Centers kCenters{};

// A Gaussian as a tile sees it: u and w at the tile's corner.
struct Local {
  float l11, l21, l22, u0, w0, lo;
};

SB_INLINE Local localize(const Record& record, const TileFrame& frame) {
  const float dx = static_cast<float>(frame.x0) - record.mx;
  const float dy = static_cast<float>(frame.y0) - record.my;
  return {record.l11, record.l21, record.l22, record.l11 * dx + record.l21 * dy, record.l22 * dy, record.lo};
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
  F u, w;
  F power;     // opacity x falloff, before the cap
  F alpha;     // 0 below 1/255
  F left;      // 1 - alpha
};

// Both passes go through here, so that they decide alike which pixel a Gaussian counts in.
SB_INLINE Alpha alpha_at(F x, F y, const float* l11, const float* l21, const float* l22, const float* u0,
                         const float* w0, const float* lo) {
  Alpha a;
  a.u = fma(set1(*l11), x, fma(set1(*l21), y, set1(*u0)));
  a.w = fma(set1(*l22), y, set1(*w0));
  const F q = fnma(a.u, a.u, fnma(a.w, a.w, set1(*lo)));
  a.power = exp2(q);
  a.alpha = min_zero_unless(q >= set1(kLog2AlphaMin), a.power, set1(kAlphaMax));
  a.left = set1(1.0F) - a.alpha;
  return a;
}

struct Step {
  F weight;  // alpha x transmittance, 0 in pixels that are or have just been closed
  M open;
};

// `through` is the product of (1 - alpha) over all Gaussians so far, those that came after the pixel was closed
// included (0 outside the image): it only falls, so it is above the limit as long as the pixel is open, and the chain
// of steps, of which each waits for the one before, is one multiplication long.
SB_INLINE Step advance(const Alpha& a, F& through, F limit) {
  const F next = through * a.left;
  const M open = next > limit;
  const F weight = mul_zero_unless(open, a.alpha, through);
  through = next;
  return {weight, open};
}

}  // namespace splatbot::SPLATBOT_KERNELS
