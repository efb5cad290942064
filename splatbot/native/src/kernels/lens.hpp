// SPDX-License-Identifier: Apache-2.0
// Affine approximation (EWA) of cameras other than the pinhole: the 2x3 derivative of the projection at the centre.
#pragma once

#include "project.hpp"

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
  AngleRatio angle;
};

template <Projection P>
SB_INLINE void linearize(const CameraLanes& cam, Projected& o, Affine& out) {
  const F zero = set1(0.0F);
  if constexpr (P == Projection::ortho) {
    out.j[0][0] = cam.fx;
    out.j[1][1] = cam.fy;
    out.j[0][1] = out.j[0][2] = out.j[1][0] = out.j[1][2] = zero;
    out.normal[0] = out.normal[1] = zero;
    out.normal[2] = cam.fx * cam.fy;
    o.mx = fma(cam.fx, o.p[0], cam.cx);
    o.my = fma(cam.fy, o.p[1], cam.cy);
  } else {
    const F x = o.p[0], y = o.p[1], z = o.p[2];
    const AngleRatio a = angle_ratio(x, y, z);
    out.j[0][0] = cam.fx * fma(x * x, a.first, a.ratio);
    out.j[0][1] = cam.fx * (x * y * a.first);
    out.j[0][2] = -(cam.fx * x * a.inverse);
    out.j[1][0] = cam.fy * (x * y * a.first);
    out.j[1][1] = cam.fy * fma(y * y, a.first, a.ratio);
    out.j[1][2] = -(cam.fy * y * a.inverse);
    // Points of one ray meet in one pixel, so the normal lies along p.
    const F size = cam.fx * cam.fy * a.ratio * a.inverse;
    for (int i = 0; i < 3; ++i) {
      out.normal[i] = size * o.p[i];
    }
    o.mx = fma(cam.fx * x, a.ratio, cam.cx);
    o.my = fma(cam.fy * y, a.ratio, cam.cy);
    out.angle = a;
  }
}

// As project_rest(), of an affine camera.
SB_INLINE void project_affine(const GaussianLanes& g, const Affine& lens, F eps2d, Projected& o) {
  F minor[3];
  for (int k = 0; k < 3; ++k) {
    for (int i = 0; i < 2; ++i) {
      o.rows[i][k] = fma(lens.j[i][0], o.a[k], fma(lens.j[i][1], o.a[3 + k], lens.j[i][2] * o.a[6 + k]));
      o.m[i][k] = o.rows[i][k] * g.scale[k];
    }
    const F along = fma(lens.normal[0], o.a[k], fma(lens.normal[1], o.a[3 + k], lens.normal[2] * o.a[6 + k]));
    minor[k] = along * g.scale[(k + 1) % 3] * g.scale[(k + 2) % 3];
  }
  const F s00 = dot3(o.m[0], o.m[0]);
  const F s11 = dot3(o.m[1], o.m[1]);
  o.c01 = dot3(o.m[0], o.m[1]);
  o.c00 = s00 + eps2d;
  o.c11 = s11 + eps2d;
  o.det = fma(minor[0], minor[0], fma(minor[1], minor[1], fma(minor[2], minor[2], eps2d * (s00 + s11 + eps2d))));
}

// Gradients of the image of a Gaussian: 2D mean, 2D covariance (of its three entries), depth.
struct ImageGradient {
  F mx, my, c00, c01, c11, z;
};

// Gradients in the camera frame: of the centre, of the Gaussian's axes (Projected::a), of its scales.
struct CameraFrameGradient {
  F p[3], a[9], scale[3];
};

template <Projection P>
SB_INLINE void pull_back_affine(const GaussianLanes& g, const CameraLanes& cam, const Projected& o, const Affine& lens,
                                const ImageGradient& image, CameraFrameGradient& out) {
  const F two = set1(2.0F), zero = set1(0.0F);
  F gj[2][3] = {{zero, zero, zero}, {zero, zero, zero}};
  for (int k = 0; k < 3; ++k) {
    const F m[2] = {two * fma(image.c00, o.m[0][k], image.c01 * o.m[1][k]),
                    two * fma(image.c01, o.m[0][k], image.c11 * o.m[1][k])};
    out.scale[k] = fma(o.rows[0][k], m[0], o.rows[1][k] * m[1]);
    const F row[2] = {m[0] * g.scale[k], m[1] * g.scale[k]};
    for (int c = 0; c < 3; ++c) {
      out.a[3 * c + k] = fma(lens.j[0][c], row[0], lens.j[1][c] * row[1]);
      for (int i = 0; i < 2; ++i) {
        gj[i][c] = fma(row[i], o.a[3 * c + k], gj[i][c]);
      }
    }
  }
  for (int c = 0; c < 3; ++c) {
    out.p[c] = fma(image.mx, lens.j[0][c], image.my * lens.j[1][c]);
  }
  out.p[2] = out.p[2] + image.z;
  if constexpr (P == Projection::fisheye) {
    const AngleRatio& t = lens.angle;
    const F x = o.p[0], y = o.p[1], z = o.p[2], xy = x * y;
    for (int c = 0; c < 3; ++c) {
      gj[0][c] = gj[0][c] * cam.fx;
      gj[1][c] = gj[1][c] * cam.fy;
    }
    const F cross = gj[0][1] + gj[1][0];
    const F g_ratio = gj[0][0] + gj[1][1];
    const F g_first = fma(x * x, gj[0][0], fma(xy, cross, y * y * gj[1][1]));
    const F g_inverse = -fma(x, gj[0][2], y * gj[1][2]);
    // Of r: shared by ratio, first and inverse, whose derivatives by x and y are x and y times this.
    const F radial = fma(g_ratio, t.first, fma(g_first, t.second, set1(-2.0F) * g_inverse * t.inverse * t.inverse));
    out.p[0] = out.p[0] + fma(x, radial, fma(t.first, fma(two * x, gj[0][0], y * cross), -(t.inverse * gj[0][2])));
    out.p[1] = out.p[1] + fma(y, radial, fma(t.first, fma(two * y, gj[1][1], x * cross), -(t.inverse * gj[1][2])));
    const F i2 = t.inverse * t.inverse;
    out.p[2] = out.p[2] + fma(two * i2, fnma(z, g_inverse, g_first), -(t.inverse * g_ratio));
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
