// SPDX-License-Identifier: Apache-2.0
// One vector type per instruction set: AVX-512 (16 lanes), AVX2 with FMA (8), else the compiler's own 4-lane vectors
// (SSE4.2, NEON). F holds floats, I 32-bit integers, M one truth value a lane. Contraction is disabled for these
// files. A product and a sum fuse only in fma(), so that forward and backward round alike.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>

#if defined(SPLATBOT_X86)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

#define SB_INLINE inline __attribute__((always_inline))

namespace splatbot::SPLATBOT_KERNELS {

#if SPLATBOT_SIMD == 512

inline constexpr int W = 16;
struct F {
  __m512 v;
};
struct I {
  __m512i v;
};
struct M {
  __mmask16 v;
};

#define SB_X86(name) _mm512_##name
#define SB_X86_BITS(name) _mm512_##name##512
SB_INLINE F bit_cast_float(I a) { return {_mm512_castsi512_ps(a.v)}; }

#elif SPLATBOT_SIMD == 256

inline constexpr int W = 8;
struct F {
  __m256 v;
};
struct I {
  __m256i v;
};
struct M {
  __m256 v;
};

#define SB_X86(name) _mm256_##name
#define SB_X86_BITS(name) _mm256_##name##256
SB_INLINE F bit_cast_float(I a) { return {_mm256_castsi256_ps(a.v)}; }

#else

inline constexpr int W = 4;
using Vf = float __attribute__((vector_size(16)));
using Vi = std::int32_t __attribute__((vector_size(16)));
struct F {
  Vf v;
};
struct I {
  Vi v;
};
struct M {
  Vi v;
};

#endif

// Intrinsics that AVX-512 and AVX2 name alike: SB_X86 completes their names, SB_X86_BITS those for untyped bits.
#if SPLATBOT_SIMD >= 256

SB_INLINE F set1(float x) { return {SB_X86(set1_ps)(x)}; }
SB_INLINE F load(const float* p) { return {SB_X86(loadu_ps)(p)}; }
SB_INLINE void store(float* p, F a) { SB_X86(storeu_ps)(p, a.v); }
SB_INLINE F operator+(F a, F b) { return {SB_X86(add_ps)(a.v, b.v)}; }
SB_INLINE F operator-(F a, F b) { return {SB_X86(sub_ps)(a.v, b.v)}; }
SB_INLINE F operator*(F a, F b) { return {SB_X86(mul_ps)(a.v, b.v)}; }
SB_INLINE F operator/(F a, F b) { return {SB_X86(div_ps)(a.v, b.v)}; }
SB_INLINE F fma(F a, F b, F c) { return {SB_X86(fmadd_ps)(a.v, b.v, c.v)}; }
SB_INLINE F fnma(F a, F b, F c) { return {SB_X86(fnmadd_ps)(a.v, b.v, c.v)}; }
SB_INLINE F fms(F a, F b, F c) { return {SB_X86(fmsub_ps)(a.v, b.v, c.v)}; }
SB_INLINE F min(F a, F b) { return {SB_X86(min_ps)(a.v, b.v)}; }
SB_INLINE F max(F a, F b) { return {SB_X86(max_ps)(a.v, b.v)}; }
SB_INLINE F sqrt(F a) { return {SB_X86(sqrt_ps)(a.v)}; }
SB_INLINE I to_int(F a) { return {SB_X86(cvttps_epi32)(a.v)}; }
SB_INLINE F to_float(I a) { return {SB_X86(cvtepi32_ps)(a.v)}; }
SB_INLINE I bit_cast_int(F a) { return {SB_X86_BITS(castps_si)(a.v)}; }
SB_INLINE I set1(int x) { return {SB_X86(set1_epi32)(x)}; }
SB_INLINE I operator+(I a, I b) { return {SB_X86(add_epi32)(a.v, b.v)}; }
SB_INLINE I operator-(I a, I b) { return {SB_X86(sub_epi32)(a.v, b.v)}; }
SB_INLINE I operator&(I a, I b) { return {SB_X86_BITS(and_si)(a.v, b.v)}; }
SB_INLINE I operator|(I a, I b) { return {SB_X86_BITS(or_si)(a.v, b.v)}; }
SB_INLINE I shift_left(I a, I n) { return {SB_X86(sllv_epi32)(a.v, n.v)}; }
template <int N>
SB_INLINE I shift_left(I a) {
  return {SB_X86(slli_epi32)(a.v, N)};
}
template <int N>
SB_INLINE I shift_right(I a) {  // arithmetic
  return {SB_X86(srai_epi32)(a.v, N)};
}
// Each quad of lanes of four vectors is a 4x4 matrix: transpose it.
SB_INLINE void transpose_quads(F (&a)[4]) {
  const auto low01 = SB_X86(castps_pd)(SB_X86(unpacklo_ps)(a[0].v, a[1].v));
  const auto high01 = SB_X86(castps_pd)(SB_X86(unpackhi_ps)(a[0].v, a[1].v));
  const auto low23 = SB_X86(castps_pd)(SB_X86(unpacklo_ps)(a[2].v, a[3].v));
  const auto high23 = SB_X86(castps_pd)(SB_X86(unpackhi_ps)(a[2].v, a[3].v));
  a[0] = {SB_X86(castpd_ps)(SB_X86(unpacklo_pd)(low01, low23))};
  a[1] = {SB_X86(castpd_ps)(SB_X86(unpackhi_pd)(low01, low23))};
  a[2] = {SB_X86(castpd_ps)(SB_X86(unpacklo_pd)(high01, high23))};
  a[3] = {SB_X86(castpd_ps)(SB_X86(unpackhi_pd)(high01, high23))};
}

#undef SB_X86
#undef SB_X86_BITS

#endif

#if SPLATBOT_SIMD == 512

// Four floats, over and over.
SB_INLINE F load_quad(const float* p) { return {_mm512_broadcast_f32x4(_mm_loadu_ps(p))}; }
SB_INLINE F floor(F a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)}; }
SB_INLINE F ceil(F a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC)}; }
SB_INLINE M operator<(F a, F b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
SB_INLINE M operator<=(F a, F b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
SB_INLINE M operator>(F a, F b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
SB_INLINE M operator>=(F a, F b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
SB_INLINE M operator&(M a, M b) { return {static_cast<__mmask16>(a.v & b.v)}; }
SB_INLINE M and_not(M a, M b) { return {static_cast<__mmask16>(a.v & ~b.v)}; }  // a and not b
SB_INLINE F select(M m, F a, F b) { return {_mm512_mask_blend_ps(m.v, b.v, a.v)}; }
SB_INLINE F zero_unless(M m, F a) { return {_mm512_maskz_mov_ps(m.v, a.v)}; }
SB_INLINE F mul_zero_unless(M m, F a, F b) { return {_mm512_maskz_mul_ps(m.v, a.v, b.v)}; }
SB_INLINE std::uint32_t bits(M m) { return m.v; }
SB_INLINE F min_zero_unless(M m, F a, F b) { return {_mm512_maskz_min_ps(m.v, a.v, b.v)}; }
SB_INLINE I floor_to_int(F a) { return {_mm512_cvt_roundps_epi32(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)}; }
SB_INLINE I ceil_to_int(F a) { return {_mm512_cvt_roundps_epi32(a.v, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC)}; }
SB_INLINE void store(std::uint32_t* p, I a) { _mm512_storeu_si512(p, a.v); }
SB_INLINE M operator==(I a, I b) { return {_mm512_cmpeq_epi32_mask(a.v, b.v)}; }
SB_INLINE M operator>(I a, I b) { return {_mm512_cmpgt_epi32_mask(a.v, b.v)}; }
SB_INLINE I zero_unless(M m, I a) { return {_mm512_maskz_mov_epi32(m.v, a.v)}; }
SB_INLINE F reciprocal(F a) {  // one Newton step from 14 bits
  const __m512 r = _mm512_rcp14_ps(a.v);
  return {_mm512_mul_ps(r, _mm512_fnmadd_ps(a.v, r, _mm512_set1_ps(2.0F)))};
}

// Square roots of positive numbers with a relative error below kRootError.
inline constexpr float kRootError = 0x1p-13F;
SB_INLINE F rough_sqrt(F a) { return {_mm512_mul_ps(a.v, _mm512_rsqrt14_ps(a.v))}; }

// The lanes of a matrix of quads, column by column, as four lines `stride` apart; and the way back.
SB_INLINE void store_lines(float* to, std::size_t stride, F a) {
  const __m512i across = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
  const __m512 lines = _mm512_permutexvar_ps(across, a.v);
  _mm_storeu_ps(to, _mm512_castps512_ps128(lines));
  _mm_storeu_ps(to + stride, _mm512_extractf32x4_ps(lines, 1));
  _mm_storeu_ps(to + 2 * stride, _mm512_extractf32x4_ps(lines, 2));
  _mm_storeu_ps(to + 3 * stride, _mm512_extractf32x4_ps(lines, 3));
}
SB_INLINE F load_lines(const float* from, std::size_t stride) {
  const __m512i across = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
  __m512 lines = _mm512_castps128_ps512(_mm_loadu_ps(from));
  lines = _mm512_insertf32x4(lines, _mm_loadu_ps(from + stride), 1);
  lines = _mm512_insertf32x4(lines, _mm_loadu_ps(from + 2 * stride), 2);
  lines = _mm512_insertf32x4(lines, _mm_loadu_ps(from + 3 * stride), 3);
  return {_mm512_permutexvar_ps(across, lines)};
}

#elif SPLATBOT_SIMD == 256

SB_INLINE F load_quad(const float* p) { return {_mm256_broadcast_ps(reinterpret_cast<const __m128*>(p))}; }
SB_INLINE F floor(F a) { return {_mm256_floor_ps(a.v)}; }
SB_INLINE F ceil(F a) { return {_mm256_ceil_ps(a.v)}; }
SB_INLINE M operator<(F a, F b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_LT_OQ)}; }
SB_INLINE M operator<=(F a, F b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_LE_OQ)}; }
SB_INLINE M operator>(F a, F b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GT_OQ)}; }
SB_INLINE M operator>=(F a, F b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
SB_INLINE M operator&(M a, M b) { return {_mm256_and_ps(a.v, b.v)}; }
SB_INLINE M and_not(M a, M b) { return {_mm256_andnot_ps(b.v, a.v)}; }
SB_INLINE F select(M m, F a, F b) { return {_mm256_blendv_ps(b.v, a.v, m.v)}; }
SB_INLINE F zero_unless(M m, F a) { return {_mm256_and_ps(m.v, a.v)}; }
SB_INLINE F mul_zero_unless(M m, F a, F b) { return zero_unless(m, a * b); }
SB_INLINE std::uint32_t bits(M m) { return static_cast<std::uint32_t>(_mm256_movemask_ps(m.v)); }
SB_INLINE F min_zero_unless(M m, F a, F b) { return zero_unless(m, min(a, b)); }
SB_INLINE void store(std::uint32_t* p, I a) { _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), a.v); }
SB_INLINE M operator==(I a, I b) { return {_mm256_castsi256_ps(_mm256_cmpeq_epi32(a.v, b.v))}; }
SB_INLINE M operator>(I a, I b) { return {_mm256_castsi256_ps(_mm256_cmpgt_epi32(a.v, b.v))}; }
SB_INLINE I zero_unless(M m, I a) { return {_mm256_and_si256(_mm256_castps_si256(m.v), a.v)}; }
SB_INLINE F reciprocal(F a) { return set1(1.0F) / a; }

#else

SB_INLINE F set1(float x) { return {Vf{x, x, x, x}}; }
SB_INLINE I set1(int x) { return {Vi{x, x, x, x}}; }
SB_INLINE F load(const float* p) {
  F r;
  std::memcpy(&r.v, p, sizeof(r.v));
  return r;
}
SB_INLINE F load_quad(const float* p) { return load(p); }
SB_INLINE void store(float* p, F a) { std::memcpy(p, &a.v, sizeof(a.v)); }
SB_INLINE void store(std::uint32_t* p, I a) { std::memcpy(p, &a.v, sizeof(a.v)); }
SB_INLINE F operator+(F a, F b) { return {a.v + b.v}; }
SB_INLINE F operator-(F a, F b) { return {a.v - b.v}; }
SB_INLINE F operator*(F a, F b) { return {a.v * b.v}; }
SB_INLINE F operator/(F a, F b) { return {a.v / b.v}; }
#if defined(__ARM_NEON) && defined(__aarch64__)
SB_INLINE F fma(F a, F b, F c) { return {reinterpret_cast<Vf>(vfmaq_f32(c.v, a.v, b.v))}; }
SB_INLINE F fnma(F a, F b, F c) { return {reinterpret_cast<Vf>(vfmsq_f32(c.v, a.v, b.v))}; }
#else
SB_INLINE F fma(F a, F b, F c) { return {a.v * b.v + c.v}; }
SB_INLINE F fnma(F a, F b, F c) { return {c.v - a.v * b.v}; }
#endif
SB_INLINE F fms(F a, F b, F c) { return {a.v * b.v - c.v}; }
SB_INLINE M operator<(F a, F b) { return {a.v < b.v}; }
SB_INLINE M operator<=(F a, F b) { return {a.v <= b.v}; }
SB_INLINE M operator>(F a, F b) { return {a.v > b.v}; }
SB_INLINE M operator>=(F a, F b) { return {a.v >= b.v}; }
SB_INLINE M operator&(M a, M b) { return {a.v & b.v}; }
SB_INLINE M and_not(M a, M b) { return {a.v & ~b.v}; }
SB_INLINE F select(M m, F a, F b) { return {m.v ? a.v : b.v}; }
SB_INLINE F zero_unless(M m, F a) { return {reinterpret_cast<Vf>(m.v & reinterpret_cast<Vi>(a.v))}; }
SB_INLINE I zero_unless(M m, I a) { return {m.v & a.v}; }
SB_INLINE F mul_zero_unless(M m, F a, F b) { return zero_unless(m, a * b); }
SB_INLINE F min(F a, F b) { return {a.v < b.v ? a.v : b.v}; }
SB_INLINE F max(F a, F b) { return {a.v > b.v ? a.v : b.v}; }
SB_INLINE F min_zero_unless(M m, F a, F b) { return zero_unless(m, min(a, b)); }
SB_INLINE F sqrt(F a) {
  F r;
  for (int i = 0; i < W; ++i) {
    r.v[i] = __builtin_sqrtf(a.v[i]);
  }
  return r;
}
SB_INLINE F floor(F a) {
  F r;
  for (int i = 0; i < W; ++i) {
    r.v[i] = __builtin_floorf(a.v[i]);
  }
  return r;
}
SB_INLINE F ceil(F a) {
  F r;
  for (int i = 0; i < W; ++i) {
    r.v[i] = __builtin_ceilf(a.v[i]);
  }
  return r;
}
SB_INLINE std::uint32_t sign_bits(F a) {
#if defined(SPLATBOT_X86)
  return static_cast<std::uint32_t>(_mm_movemask_ps(a.v));
#else
  const Vi x = reinterpret_cast<Vi>(a.v);
  std::uint32_t r = 0;
  for (int i = 0; i < W; ++i) {
    r |= (static_cast<std::uint32_t>(x[i]) >> 31) << i;
  }
  return r;
#endif
}
SB_INLINE std::uint32_t bits(M m) { return sign_bits({reinterpret_cast<Vf>(m.v)}); }
SB_INLINE I to_int(F a) { return {__builtin_convertvector(a.v, Vi)}; }
SB_INLINE F to_float(I a) { return {__builtin_convertvector(a.v, Vf)}; }
SB_INLINE I bit_cast_int(F a) { return {reinterpret_cast<Vi>(a.v)}; }
SB_INLINE F bit_cast_float(I a) { return {reinterpret_cast<Vf>(a.v)}; }
SB_INLINE I operator+(I a, I b) { return {a.v + b.v}; }
SB_INLINE I operator-(I a, I b) { return {a.v - b.v}; }
SB_INLINE I operator&(I a, I b) { return {a.v & b.v}; }
SB_INLINE M operator==(I a, I b) { return {a.v == b.v}; }
SB_INLINE M operator>(I a, I b) { return {a.v > b.v}; }
SB_INLINE I operator|(I a, I b) { return {a.v | b.v}; }
template <int N>
SB_INLINE I shift_left(I a) {
  return {a.v << N};
}
template <int N>
SB_INLINE I shift_right(I a) {
  return {a.v >> N};
}
SB_INLINE I shift_left(I a, I n) { return {a.v << n.v}; }
SB_INLINE F reciprocal(F a) { return set1(1.0F) / a; }
SB_INLINE void transpose_quads(F (&a)[4]) {
  const Vf rows[4] = {a[0].v, a[1].v, a[2].v, a[3].v};
  for (int i = 0; i < 4; ++i) {
    a[i] = {Vf{rows[0][i], rows[1][i], rows[2][i], rows[3][i]}};
  }
}

#endif

#if SPLATBOT_SIMD != 512
SB_INLINE I floor_to_int(F a) { return to_int(floor(a)); }
SB_INLINE I ceil_to_int(F a) { return to_int(ceil(a)); }
inline constexpr float kRootError = 0.0F;
SB_INLINE F rough_sqrt(F a) { return sqrt(a); }

SB_INLINE void store_lines(float* to, std::size_t stride, F a) {
  float lanes[W];
  store(lanes, a);
  for (std::size_t i = 0; i < W; ++i) {
    to[(i % 4) * stride + i / 4] = lanes[i];
  }
}
SB_INLINE F load_lines(const float* from, std::size_t stride) {
  float lanes[W];
  for (std::size_t i = 0; i < W; ++i) {
    lanes[i] = from[(i % 4) * stride + i / 4];
  }
  return load(lanes);
}

// The nearest integer by adding 1.5 x 2^23; for |q| < 2^22 only, which callers ensure or mask out.
SB_INLINE void split_exponent(F q, F& fraction, F& whole) {
  whole = q + set1(12582912.0F);
  fraction = q - (whole - set1(12582912.0F));
}
SB_INLINE F scale_exponent(F a, F whole) {
  return bit_cast_float(bit_cast_int(a) + shift_left<23>(bit_cast_int(whole)));
}
#endif

SB_INLINE F operator-(F a) { return set1(0.0F) - a; }
SB_INLINE F clamp(F x, F low, F high) { return min(max(x, low), high); }
SB_INLINE F square(F x) { return x * x; }

#if SPLATBOT_SIMD == 512
// Bits of 2^(k/32) less k << 18, which exp2() adds again with the exponent.
alignas(64) inline constexpr std::uint32_t kRoots[32] = {
    0x3f800000, 0x3f7ecd87, 0x3f7daac3, 0x3f7c980f, 0x3f7b95c2, 0x3f7aa43a, 0x3f79c3d3, 0x3f78f4f0,
    0x3f7837f0, 0x3f778d3a, 0x3f76f532, 0x3f767043, 0x3f75fed7, 0x3f75a15b, 0x3f75583f, 0x3f7523f6,
    0x3f7504f3, 0x3f74fbaf, 0x3f7508a4, 0x3f752c4d, 0x3f75672a, 0x3f75b9be, 0x3f76248c, 0x3f76a81e,
    0x3f7744fd, 0x3f77fbb8, 0x3f78ccdf, 0x3f79b907, 0x3f7ac0c7, 0x3f7be4ba, 0x3f7d257d, 0x3f7e83b3};

// 2^q to 1.2e-7 relative for -126 <= q < 128, with q = n + k/32 + x, |x| <= 1/64. 2^(k/32) comes from a table in two
// registers, n is added to its exponent, 2^x is a minimax polynomial of degree 2. Multiplications are few: they limit
// the blend loops.
SB_INLINE F exp2(F q) {
  const F magic = set1(393216.0F);  // 1.5 x 2^18: the last bit is worth 1/32, so t ends in 32 n + k
  const F t = q + magic;
  const F x = q - (t - magic);
  const __m512i k = _mm512_castps_si512(t.v);
  const __m512i root = _mm512_permutex2var_epi32(_mm512_load_si512(kRoots), k, _mm512_load_si512(kRoots + 16));
  const F scale = {_mm512_castsi512_ps(_mm512_add_epi32(root, _mm512_slli_epi32(k, 18)))};
#if SPLATBOT_EXP_DEGREE == 1  // 2.9e-5
  return fma(set1(0.693160721F), x, set1(1.00002933F)) * scale;
#elif SPLATBOT_EXP_DEGREE == 3  // 6e-8, all of it rounding
  return fma(fma(fma(set1(0.0555041F), x, set1(0.2402265F)), x, set1(0.6931472F)), x, set1(1.0F)) * scale;
#else
  return fma(fma(set1(0.240224746F), x, set1(0.693157344F)), x, set1(1.0F)) * scale;
#endif
}
#else
// 2^q to 7.5e-8 relative (a minimax polynomial of degree 5 on [-1/2, 1/2]).
SB_INLINE F exp2(F q) {
  F x, whole;
  split_exponent(q, x, whole);
  F p = fma(set1(1.3276471e-3F), x, set1(9.6755413e-3F));
  p = fma(p, x, set1(5.5507133e-2F));
  p = fma(p, x, set1(2.4022120e-1F));
  p = fma(p, x, set1(6.9314697e-1F));
  p = fma(p, x, set1(1.0000001F));
  return scale_exponent(p, whole);
}

#endif
// log2 of normal positive numbers, to 1e-7: mantissa in [1/sqrt 2, sqrt 2), then the series of atanh.
SB_INLINE F log2(F a) {
  const I shifted = bit_cast_int(a) - set1(0x3f3504f3);
  const I exponent = shift_right<23>(shifted);
  const F m = bit_cast_float((shifted & set1(0x007fffff)) + set1(0x3f3504f3));
  const F s = (m - set1(1.0F)) / (m + set1(1.0F));
  const F s2 = s * s;
  F p = fma(s2, set1(0.3205989F), set1(0.4121986F));
  p = fma(p, s2, set1(0.5770780F));
  p = fma(p, s2, set1(0.9617967F));
  return fma(s, fma(p, s2, set1(2.8853901F)), to_float(exponent));
}

// A number or a flag as a type: an argument that may be a template's.
template <auto N>
struct Constant {
  constexpr operator decltype(N)() const { return N; }
};

// Sum over lanes, from the first to the last.
SB_INLINE float total(F a) {
  alignas(64) float lanes[W];
  store(lanes, a);
  float sum = 0.0F;
  for (int i = 0; i < W; ++i) {
    sum += lanes[i];
  }
  return sum;
}

// The 16 sums over lanes of acc[0..n-1], zero beyond n, in a fixed order.
#if SPLATBOT_SIMD == 512
SB_INLINE F add_pairs(F a, F b) {
  return {_mm512_add_ps(_mm512_unpacklo_ps(a.v, b.v), _mm512_unpackhi_ps(a.v, b.v))};
}
SB_INLINE F add_quads(F ab, F cd) {
  const __m512d x = _mm512_castps_pd(ab.v);
  const __m512d y = _mm512_castps_pd(cd.v);
  return F{_mm512_castpd_ps(_mm512_unpacklo_pd(x, y))} + F{_mm512_castpd_ps(_mm512_unpackhi_pd(x, y))};
}
template <int N>
SB_INLINE F sums(const F (&acc)[16]) {
  F q[4];
#pragma GCC unroll 4
  for (int i = 0; i < 4; ++i) {
    if (4 * i + 2 < N) {
      q[i] = add_quads(add_pairs(acc[4 * i], acc[4 * i + 1]), add_pairs(acc[4 * i + 2], acc[4 * i + 3]));
    } else if (4 * i < N) {
      q[i] = add_quads(add_pairs(acc[4 * i], acc[4 * i + 1]), set1(0.0F));
    } else {
      q[i] = set1(0.0F);
    }
  }
  const F x = {_mm512_add_ps(_mm512_shuffle_f32x4(q[0].v, q[1].v, 0x44), _mm512_shuffle_f32x4(q[0].v, q[1].v, 0xEE))};
  const F y = {_mm512_add_ps(_mm512_shuffle_f32x4(q[2].v, q[3].v, 0x44), _mm512_shuffle_f32x4(q[2].v, q[3].v, 0xEE))};
  return {_mm512_add_ps(_mm512_shuffle_f32x4(x.v, y.v, 0x88), _mm512_shuffle_f32x4(x.v, y.v, 0xDD))};
}
template <int N>
SB_INLINE void store_sums(float* out, const F (&acc)[16]) {
  store(out, sums<N>(acc));
}
#elif SPLATBOT_SIMD == 256
template <int N>
SB_INLINE void store_sums(float* out, const F (&acc)[16]) {
#pragma GCC unroll 4
  for (int i = 0; i < 16; i += 4) {
    __m128 s = _mm_setzero_ps();
    if (i < N) {
      const __m256 ab = _mm256_hadd_ps(acc[i].v, acc[i + 1].v);
      const __m256 cd = _mm256_hadd_ps(acc[i + 2].v, acc[i + 3].v);
      const __m256 quad = _mm256_hadd_ps(ab, cd);
      s = _mm_add_ps(_mm256_castps256_ps128(quad), _mm256_extractf128_ps(quad, 1));
    }
    _mm_storeu_ps(out + i, s);
  }
}
#else
template <int N>
SB_INLINE void store_sums(float* out, const F (&acc)[16]) {
  for (int i = 0; i < 16; ++i) {
    out[i] = i < N ? (acc[i].v[0] + acc[i].v[1]) + (acc[i].v[2] + acc[i].v[3]) : 0.0F;
  }
}
#endif

}  // namespace splatbot::SPLATBOT_KERNELS
