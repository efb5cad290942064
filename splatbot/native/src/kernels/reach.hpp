// SPDX-License-Identifier: Apache-2.0
// Which 4x4-pixel blocks of a tile a Gaussian's ellipse meets.
#pragma once

#include "tile.hpp"

namespace splatbot::SPLATBOT_KERNELS {

// Fields of the records of one chunk, side by side.
struct ChunkEllipses {
  alignas(64) float cx[kChunk], cy[kChunk];  // centre, from the tile's corner
  alignas(64) float l11[kChunk], l21[kChunk], l22[kChunk], reach[kChunk], lean[kChunk];
};

// For each of n Gaussians, a bit for each block whose rectangle of pixel centres meets u^2 + w^2 <= reach^2. Exact for
// each row of blocks: the ellipse cut by the row's strip is convex, so it meets the blocks that its extent in x spans,
// and that extent ends at the ellipse's outermost point or, if that is outside, where the strip's nearer edge cuts it.
SB_INLINE void block_masks(const ChunkEllipses& e, int n, std::uint32_t* masks) {
  constexpr float kMargin = 0.01F;  // [px], against rounding
  const F zero = set1(0.0F);
  for (int i = 0; i < n; i += W) {
    const F cx = load(e.cx + i), cy = load(e.cy + i), l22 = load(e.l22 + i), r = load(e.reach + i);
    const F lean = load(e.lean + i);
    const F inverse = set1(1.0F) / load(e.l11 + i);
    const F shear = load(e.l21 + i) / l22;
    const F r2 = r * r;
    I mask = set1(0);
#pragma GCC unroll 4
    for (int row = 0; row < kBlockRows; ++row) {
      const F top = l22 * (set1(static_cast<float>(kBlock * row) + 0.5F - kMargin) - cy);
      const F bottom = l22 * (set1(static_cast<float>(kBlock * row + kBlock) - 0.5F + kMargin) - cy);
      const F low = max(top, -r);
      const F high = min(bottom, r);
      const F w_right = min(max(lean, low), high);
      const F w_left = min(max(-lean, low), high);
      const F right = fma(sqrt(max(r2 - w_right * w_right, zero)) - shear * w_right, inverse, cx);
      const F left = fnma(sqrt(max(r2 - w_left * w_left, zero)) + shear * w_left, inverse, cx);
      const F last = floor((right - set1(0.5F - kMargin)) * set1(1.0F / kBlock));
      const F first = ceil((left - set1(static_cast<float>(kBlock) - 0.5F + kMargin)) * set1(1.0F / kBlock));
      const M meets = (low <= high) & (first <= last) & (last >= zero) & (first <= set1(kBlockColumns - 1.0F));
      const I from = to_int(clamp(first, zero, set1(kBlockColumns - 1.0F)));
      const I to = to_int(clamp(last, zero, set1(kBlockColumns - 1.0F)));
      // Bits from..to: 2^(to + 1) - 2^from.
      const I span = shift_left(set1(2), to) - shift_left(set1(1), from);
      mask = mask | shift_left(zero_unless(meets, span), set1(kBlockColumns * row));
    }
    store(masks + i, mask);
  }
}

// Row j, bit b of 64 masks becomes row b, bit j of 32.
SB_INLINE void transpose_masks(const std::uint32_t* masks, std::uint64_t* columns) {
#if SPLATBOT_SIMD == 512
  const __m512i m0 = _mm512_loadu_si512(masks), m1 = _mm512_loadu_si512(masks + 16);
  const __m512i m2 = _mm512_loadu_si512(masks + 32), m3 = _mm512_loadu_si512(masks + 48);
#pragma GCC unroll 4
  for (int b = 0; b < kBlocks; ++b) {
    const __m512i bit = _mm512_set1_epi32(static_cast<int>(1U << b));
    const std::uint32_t low = _mm512_kunpackw(_mm512_test_epi32_mask(m1, bit), _mm512_test_epi32_mask(m0, bit));
    const std::uint32_t high = _mm512_kunpackw(_mm512_test_epi32_mask(m3, bit), _mm512_test_epi32_mask(m2, bit));
    columns[b] = std::uint64_t{high} << 32 | low;
  }
#else
  for (int half = 0; half < 2; ++half) {
    std::uint32_t a[32];  // Warren 2013, Hacker's Delight, 7-3, for bit 0 in column 0
    std::memcpy(a, masks + 32 * half, sizeof(a));
    std::uint32_t select_low = 0x0000ffffU;
    for (int step = 16; step != 0; step >>= 1, select_low ^= select_low << step) {
      for (int k = 0; k < 32; k = ((k | step) + 1) & ~step) {
        const std::uint32_t swap = ((a[k] >> step) ^ a[k | step]) & select_low;
        a[k] ^= swap << step;
        a[k | step] ^= swap;
      }
    }
    for (int b = 0; b < kBlocks; ++b) {
      columns[b] = half == 0 ? a[b] : columns[b] | std::uint64_t{a[b]} << 32;
    }
  }
#endif
}

}  // namespace splatbot::SPLATBOT_KERNELS
