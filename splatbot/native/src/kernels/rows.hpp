// SPDX-License-Identifier: Apache-2.0
// Rows of arrays to lanes of vectors and back: lane i of vector c is column c of row i. Rows of up to four floats are
// loaded and stored as quads, and four vectors of quads are transposed in registers. A column of scalar stores that
// is read back as one vector would wait for all of them to reach the cache.
#pragma once

#include "simd.hpp"

namespace splatbot::SPLATBOT_KERNELS {

#if defined(SPLATBOT_X86)
using Quad = __m128;

SB_INLINE Quad load_pair(const float* p) { return _mm_castsi128_ps(_mm_loadl_epi64(reinterpret_cast<const __m128i_u*>(p))); }
#else
using Quad = float __attribute__((vector_size(16)));
#endif

// The first Width of four floats, zeros beyond.
template <int Width>
SB_INLINE Quad load_quad_of(const float* p) {
#if defined(SPLATBOT_X86)
  if constexpr (Width == 4) {
    return _mm_loadu_ps(p);
  } else if constexpr (Width == 2) {
    return load_pair(p);
  } else {
    static_assert(Width == 3);
    return _mm_insert_ps(load_pair(p), _mm_load_ss(p + 2), 0x20);
  }
#else
  Quad q = {};
  std::memcpy(&q, p, Width * sizeof(float));
  return q;
#endif
}

template <int Width>
SB_INLINE void store_quad_of(float* p, Quad q) {
#if defined(SPLATBOT_X86)
  if constexpr (Width == 4) {
    _mm_storeu_ps(p, q);
  } else {
    static_assert(Width == 2 || Width == 3);
    _mm_storel_epi64(reinterpret_cast<__m128i_u*>(p), _mm_castps_si128(q));
    if constexpr (Width == 3) {
      _mm_store_ss(p + 2, _mm_movehl_ps(q, q));
    }
  }
#else
  std::memcpy(p, &q, Width * sizeof(float));
#endif
}

// A vector of the quads that quad(0), quad(1) ... give, and the k-th quad of a vector.
template <class Each>
SB_INLINE F join_quads(Each quad) {
#if SPLATBOT_SIMD == 512
  const __m512 low = _mm512_insertf32x4(_mm512_castps128_ps512(quad(0)), quad(1), 1);
  return {_mm512_insertf32x4(_mm512_insertf32x4(low, quad(2), 2), quad(3), 3)};
#elif SPLATBOT_SIMD == 256
  return {_mm256_insertf128_ps(_mm256_castps128_ps256(quad(0)), quad(1), 1)};
#else
  F r;
  const Quad q = quad(0);
  std::memcpy(&r.v, &q, sizeof(q));
  return r;
#endif
}

template <class Each>
SB_INLINE void each_quad(F a, Each each) {
#if SPLATBOT_SIMD == 512
  each(0, _mm512_castps512_ps128(a.v));
  each(1, _mm512_extractf32x4_ps(a.v, 1));
  each(2, _mm512_extractf32x4_ps(a.v, 2));
  each(3, _mm512_extractf32x4_ps(a.v, 3));
#elif SPLATBOT_SIMD == 256
  each(0, _mm256_castps256_ps128(a.v));
  each(1, _mm256_extractf128_ps(a.v, 1));
#else
  Quad q;
  std::memcpy(&q, &a.v, sizeof(q));
  each(0, q);
#endif
}

// The first Width <= 4 floats of the W rows that begin at row(i); vectors beyond Width are zero.
template <int Width, class Row>
SB_INLINE void load_rows(Row row, F (&out)[4]) {
  for (int k = 0; k < 4; ++k) {
    out[k] = join_quads([&](int q) { return load_quad_of<Width>(row(4 * q + k)); });
  }
  transpose_quads(out);
}

// Columns 0..3 of W rows, to where row(i) says, the first Width of each.
template <int Width, class Row>
SB_INLINE void store_rows(Row row, const F (&columns)[4]) {
  F a[4] = {columns[0], columns[1], columns[2], columns[3]};
  transpose_quads(a);
  for (int k = 0; k < 4; ++k) {
    each_quad(a[k], [&](int q, Quad quad) { store_quad_of<Width>(row(4 * q + k), quad); });
  }
}

// Rows of an (N, Width) array that row(i) names; the last of n is repeated to W.
template <int Width, class Row>
SB_INLINE void load_columns(Row row, int n, F (&out)[Width]) {
  if constexpr (Width >= 2 && Width <= 4) {
    F all[4];
    load_rows<Width>([&](int i) { return row(i < n ? i : n - 1); }, all);
    for (int c = 0; c < Width; ++c) {
      out[c] = all[c];
    }
  } else {
    alignas(64) float lanes[Width][W];
    for (int i = 0; i < W; ++i) {
      const float* from = row(i < n ? i : n - 1);
      for (int c = 0; c < Width; ++c) {
        lanes[c][i] = from[c];
      }
    }
    for (int c = 0; c < Width; ++c) {
      out[c] = load(lanes[c]);
    }
  }
}

// Rows [first, first + n) of an (N, Width) array.
template <int Width>
SB_INLINE void load_lanes(const float* rows, std::size_t first, int n, F (&out)[Width]) {
  const float* from = rows + first * Width;
  if (Width == 1 && n == W) {
    out[0] = load(from);
  } else {
    load_columns<Width>([&](int i) { return from + i * Width; }, n, out);
  }
}

// The same for any rows.
template <int Width>
SB_INLINE void gather_lanes(const float* rows, const std::uint32_t* ids, int n, F (&out)[Width]) {
  load_columns<Width>([&](int i) { return rows + std::size_t{ids[i]} * Width; }, n, out);
}

SB_INLINE void put(float* to, float value, bool add) { *to = add ? *to + value : value; }

// The first n lanes to the rows named; no rows, nothing to do.
template <int Width>
SB_INLINE void scatter_lanes(float* rows, const std::uint32_t* ids, int n, const F (&values)[Width], bool add) {
  if (rows == nullptr) {
    return;
  }
  if constexpr (Width >= 2 && Width <= 4) {
    if (n == W && !add) {
      const F zero = set1(0.0F);
      const F columns[4] = {values[0], values[1], Width > 2 ? values[Width > 2 ? 2 : 0] : zero,
                            Width > 3 ? values[Width - 1] : zero};
      return store_rows<Width>([&](int i) { return rows + std::size_t{ids[i]} * Width; }, columns);
    }
  }
  alignas(64) float lanes[Width][W];
  for (int c = 0; c < Width; ++c) {
    store(lanes[c], values[c]);
  }
  for (int i = 0; i < n; ++i) {
    float* row = rows + static_cast<std::size_t>(ids[i]) * Width;
    for (int c = 0; c < Width; ++c) {
      put(row + c, lanes[c][i], add);
    }
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
