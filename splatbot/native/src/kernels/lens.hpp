// SPDX-License-Identifier: Apache-2.0
// Affine approximation (EWA) of cameras other than the pinhole: the 2x3 derivative of the projection at the centre.
#pragma once

#include "simd.hpp"
#include "splatbot/kernels.hpp"

namespace splatbot::SPLATBOT_KERNELS {

// How Gaussians come onto the image.
enum class Projection { pinhole, ortho, fisheye, unscented };

SB_INLINE Projection projection_of(const View& view) {
  if (view.lens.unscented) {
    return Projection::unscented;
  }
  switch (view.lens.model) {
    case CameraModel::ortho:
      return Projection::ortho;
    case CameraModel::fisheye:
      return Projection::fisheye;
    default:
      return Projection::pinhole;
  }
}

// With r = |(x, y)|: ratio = atan2(r, z) / r, first = (d ratio / d r) / r and second = (d first / d r) / r.
struct AngleRatio {
  F ratio, first, second, inverse;  // inverse: 1 / (r^2 + z^2)
};

// atan of x in 0..1 to 4e-8: x times a polynomial in x^2 (minimax fit).
inline constexpr float kAtan[9] = {1.0F,           -0.33333093F,  0.19993053F,   -0.14207134F, 0.10654678F,
                                   -0.07533677F, 0.04303938F, -0.016283015F, 0.0029035544F};
SB_INLINE F atan_unit(F x) {
  const F s = x * x;
  F p = set1(kAtan[8]);
#pragma GCC unroll 8
  for (int i = 7; i >= 0; --i) {
    p = fma(p, s, set1(kAtan[i]));
  }
  return p * x;
}

SB_INLINE AngleRatio angle_ratio(F x, F y, F z) {
  AngleRatio a;
  const F r2 = fma(x, x, y * y);
  a.inverse = set1(1.0F) / fma(z, z, r2);
  // Near the axis the closed forms are 0 / 0: the series of atan(t) / t in s = t^2 and of its derivatives.
  constexpr float kSeriesBelow = 0.1F;
  const F iz = set1(1.0F) / z;
  const F s = min(r2 * iz * iz, set1(kSeriesBelow));
  F ratio = set1(1.0F / 19.0F), first = set1(0.0F), second = set1(0.0F);
#pragma GCC unroll 10
  for (int n = 9; n >= 0; --n) {  // sum of (-1)^n s^n / (2 n + 1)
    const float sign = n % 2 == 0 ? 1.0F : -1.0F;
    const float c = sign / (2.0F * static_cast<float>(n) + 1.0F);
    ratio = n == 9 ? set1(c) : fma(ratio, s, set1(c));
    if (n >= 1) {
      first = fma(first, s, set1(c * static_cast<float>(n)));
    }
    if (n >= 2) {
      second = fma(second, s, set1(c * static_cast<float>(n * (n - 1))));
    }
  }
  const F iz3 = iz * iz * iz;
  const M series = r2 * iz * iz < set1(kSeriesBelow);
  const F r2_safe = select(series, set1(1.0F), r2);
  const F r = sqrt(r2_safe);
  const M steep = r > z;
  const F angle = atan_unit(select(steep, z, r) / select(steep, r, z));
  const F far_ratio = select(steep, set1(1.57079632679F) - angle, angle) / r;
  const F ir2 = set1(1.0F) / r2_safe;
  const F far_first = fms(z, a.inverse, far_ratio) * ir2;
  const F far_second = -fma(set1(2.0F) * z * a.inverse, a.inverse, set1(3.0F) * far_first) * ir2;
  a.ratio = select(series, ratio * iz, far_ratio);
  a.first = select(series, set1(2.0F) * first * iz3, far_first);
  a.second = select(series, set1(4.0F) * second * iz3 * iz * iz, far_second);
  return a;
}

struct Affine {
  F j[2][3];    // derivative of the projection
  F normal[3];  // cross product of its rows
  F mx, my;     // the centre's pixel, from the principal point
  AngleRatio angle;
};

template <Projection P>
SB_INLINE Affine affine_of(const F (&p)[3], F fx, F fy) {
  Affine out;
  const F zero = set1(0.0F);
  if constexpr (P == Projection::ortho) {
    out.j[0][0] = fx;
    out.j[1][1] = fy;
    out.j[0][1] = out.j[0][2] = out.j[1][0] = out.j[1][2] = zero;
    out.normal[0] = out.normal[1] = zero;
    out.normal[2] = fx * fy;
    out.mx = fx * p[0];
    out.my = fy * p[1];
  } else {
    const F x = p[0], y = p[1];
    const AngleRatio a = angle_ratio(x, y, p[2]);
    const F mixed = x * y * a.first;
    out.j[0][0] = fx * fma(x * x, a.first, a.ratio);
    out.j[0][1] = fx * mixed;
    out.j[0][2] = -(fx * x * a.inverse);
    out.j[1][0] = fy * mixed;
    out.j[1][1] = fy * fma(y * y, a.first, a.ratio);
    out.j[1][2] = -(fy * y * a.inverse);
    const F size = fx * fy * a.ratio * a.inverse;
    for (int i = 0; i < 3; ++i) {
      out.normal[i] = size * p[i];  // points of one ray meet in one pixel, so the normal lies along it
    }
    out.mx = fx * x * a.ratio;
    out.my = fy * y * a.ratio;
    out.angle = a;
  }
  return out;
}

// Propagates gradients to the centre p in the camera frame. They are those of its pixel (mx, my), of its depth and,
// through the covariance, of the derivative j.
template <Projection P>
SB_INLINE void pull_back_affine(const Affine& lens, const F (&p)[3], F fx, F fy, F mx, F my, F z, F (&gj)[2][3],
                                F (&out)[3]) {
  for (int c = 0; c < 3; ++c) {
    out[c] = fma(mx, lens.j[0][c], my * lens.j[1][c]);
  }
  out[2] = out[2] + z;
  if constexpr (P == Projection::fisheye) {
    const AngleRatio& t = lens.angle;
    const F two = set1(2.0F);
    const F x = p[0], y = p[1], xy = x * y;
    for (int c = 0; c < 3; ++c) {
      gj[0][c] = gj[0][c] * fx;
      gj[1][c] = gj[1][c] * fy;
    }
    const F cross = gj[0][1] + gj[1][0];
    const F g_ratio = gj[0][0] + gj[1][1];
    const F g_first = fma(x * x, gj[0][0], fma(xy, cross, y * y * gj[1][1]));
    const F g_inverse = -fma(x, gj[0][2], y * gj[1][2]);
    const F i2 = t.inverse * t.inverse;
    // Through r: the derivatives of ratio, first and inverse by x and y are x and y times those by r over r.
    const F radial = fma(g_ratio, t.first, fma(g_first, t.second, -(two * g_inverse * i2)));
    out[0] = out[0] + fma(x, radial, fma(t.first, fma(two * x, gj[0][0], y * cross), -(t.inverse * gj[0][2])));
    out[1] = out[1] + fma(y, radial, fma(t.first, fma(two * y, gj[1][1], x * cross), -(t.inverse * gj[1][2])));
    out[2] = out[2] + fma(two * i2, fnma(p[2], g_inverse, g_first), -(t.inverse * g_ratio));
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
