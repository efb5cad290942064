// SPDX-License-Identifier: Apache-2.0
// Which 4x4-pixel blocks of a tile a Gaussian's ellipse meets.
#pragma once

#include <cstddef>

#include "rows.hpp"
#include "tile.hpp"

namespace splatbot::SPLATBOT_KERNELS {

// W ellipses u^2 + w^2 <= reach^2 (see Record), their centres from the tile's corner.
struct EllipseLanes {
  F cx, cy, l11, l21, l22, reach, lean;
};

// The ellipses of the first n of W pairs; the last is repeated.
SB_INLINE EllipseLanes load_ellipses(const Record* records, const Pair* pairs, int n, const TileFrame& frame) {
  static_assert(offsetof(Record, lean) == 7 * sizeof(float));
  F first[4], second[4];
  const float* rows[W];
  for (int i = 0; i < W; ++i) {
    rows[i] = &records[pairs[i < n ? i : n - 1].id].mx;
  }
  load_rows<4>([&](int i) { return rows[i]; }, first);
  load_rows<4>([&](int i) { return rows[i] + 4; }, second);
  const F cx = first[0] - set1(static_cast<float>(frame.x0)), cy = first[1] - set1(static_cast<float>(frame.y0));
  return {cx, cy, first[2], first[3], second[0], second[2], second[3]};
}

// For each of W Gaussians, a bit for each block whose rectangle of pixel centres meets u^2 + w^2 <= reach^2. Exact for each row of blocks. The ellipse cut by the row's strip is convex, so it meets the blocks that its
// extent in x spans. That extent ends at the ellipse's outermost point or, if that is outside, at the cut of the strip's nearer
// edge.
SB_INLINE I block_masks(const EllipseLanes& e) {
  constexpr float kMargin = 0.01F;  // [px], against rounding
  constexpr float kShare = 1.0F / kBlock;
  constexpr float kFirst = 0.5F - kMargin, kLast = static_cast<float>(kBlock) - 0.5F + kMargin;  // of a block's centres
  const F zero = set1(0.0F), tiny = set1(1e-30F);
  const F center = e.l22 * e.cy;
  const F right_of = (e.cx - set1(kFirst)) * set1(kShare), left_of = (e.cx - set1(kLast)) * set1(kShare);  // in blocks
  const F scale = set1(kShare) * reciprocal(e.l11);
  const F shear = e.l21 * reciprocal(e.l22);
  const F r2 = square(e.reach * set1(1.0F + kRootError));  // so that no root comes out too small
  const F minus_reach = -e.reach, minus_lean = -e.lean;
  I mask = set1(0);
#pragma GCC unroll 4
  for (int row = 0; row < kBlockRows; ++row) {
    const F low = max(fms(e.l22, set1(static_cast<float>(kBlock * row) + kFirst), center), minus_reach);
    const F high = min(fms(e.l22, set1(static_cast<float>(kBlock * row) + kLast), center), e.reach);
    const F w_right = clamp(e.lean, low, high);
    const F w_left = clamp(minus_lean, low, high);
    const F right = fma(fnma(shear, w_right, rough_sqrt(max(r2 - w_right * w_right, tiny))), scale, right_of);
    const F left = fnma(fma(shear, w_left, rough_sqrt(max(r2 - w_left * w_left, tiny))), scale, left_of);
    const I end = floor_to_int(clamp(right, set1(-1.0F), set1(kBlockColumns - 1.0F))) + set1(1);
    const I begin = ceil_to_int(clamp(left, zero, set1(static_cast<float>(kBlockColumns))));
    const M meets = (low <= high) & (end > begin);
    const I span = shift_left(set1(1), end) - shift_left(set1(1), begin);
    mask = mask | shift_left(zero_unless(meets, span), set1(kBlockColumns * row));
  }
  return mask;
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
