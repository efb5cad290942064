// SPDX-License-Identifier: Apache-2.0
// Exact projection of points through distorted lenses, in double: the result depends on second differences of pixels.
#pragma once

#include "project.hpp"

// Long and called often: inlined everywhere, these would take the compiler minutes.
#define SB_APART inline __attribute__((noinline))

namespace splatbot::SPLATBOT_KERNELS {

inline constexpr int kHalf = W / 2;
using D = double __attribute__((vector_size(kHalf * sizeof(double))));
using DMask = std::int64_t __attribute__((vector_size(kHalf * sizeof(double))));

SB_INLINE D wide(double x) { return D{} + x; }
SB_INLINE D d_select(DMask m, D a, D b) { return m ? a : b; }
SB_INLINE D d_clamp(D x, double low, double high) {
  x = d_select(x < low, wide(low), x);
  return d_select(x > high, wide(high), x);
}
SB_INLINE D d_sqrt(D x) {
  D r;
  for (int i = 0; i < kHalf; ++i) {
    r[i] = __builtin_sqrt(x[i]);
  }
  return r;
}
SB_INLINE D d_atan2(D y, D x) {
  D r;
  for (int i = 0; i < kHalf; ++i) {
    r[i] = __builtin_atan2(y[i], x[i]);
  }
  return r;
}

// Lanes [half * kHalf, half * kHalf + kHalf).
SB_INLINE D widen(F x, int half) {
  alignas(64) float lanes[W];
  store(lanes, x);
  D r;
  for (int i = 0; i < kHalf; ++i) {
    r[i] = static_cast<double>(lanes[half * kHalf + i]);
  }
  return r;
}
SB_INLINE void narrow(D x, int half, float* lanes) {
  for (int i = 0; i < kHalf; ++i) {
    lanes[half * kHalf + i] = static_cast<float>(x[i]);
  }
}

// A projected point, with the derivative of its pixel by the point.
struct Sight {
  D u[2], j[2][3];
  DMask seen;
};

// (x, y), (xd, yd) and the derivative of the latter by the former: OpenCV's rational, tangential and thin prism model.
SB_INLINE void distort(const Lens& lens, D x, D y, D (&out)[2], D (&d)[2][2]) {
  const double *k = lens.radial, *p = lens.tangential, *s = lens.thin_prism;
  const D r2 = x * x + y * y;
  const D above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]));
  const D below = 1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]));
  const D c = above / below;
  const D slope_above = k[0] + r2 * (2.0 * k[1] + r2 * (3.0 * k[2]));
  const D slope_below = k[3] + r2 * (2.0 * k[4] + r2 * (3.0 * k[5]));
  const D dc = 2.0 * (slope_above - c * slope_below) / below;  // (d c / d r) / r
  const D px = 2.0 * (s[0] + 2.0 * s[1] * r2), py = 2.0 * (s[2] + 2.0 * s[3] * r2);
  const D xy = x * y;
  out[0] = x * c + 2.0 * p[0] * xy + p[1] * (r2 + 2.0 * x * x) + r2 * (s[0] + s[1] * r2);
  out[1] = y * c + p[0] * (r2 + 2.0 * y * y) + 2.0 * p[1] * xy + r2 * (s[2] + s[3] * r2);
  d[0][0] = c + x * x * dc + 2.0 * p[0] * y + 6.0 * p[1] * x + x * px;
  d[0][1] = xy * dc + 2.0 * p[0] * x + 2.0 * p[1] * y + y * px;
  d[1][0] = xy * dc + 2.0 * p[0] * x + 2.0 * p[1] * y + x * py;
  d[1][1] = c + y * y * dc + 6.0 * p[0] * y + 2.0 * p[1] * x + y * py;
}

SB_APART Sight see_pinhole(const View& view, const D (&q)[3]) {
  const Lens& lens = view.lens;
  const DMask before = (q[2] >= lens.nearest) & (q[2] > 0.0);
  const D iz = 1.0 / d_select(before, q[2], wide(1.0));
  const D x = q[0] * iz, y = q[1] * iz;
  D point[2], d[2][2];
  distort(lens, x, y, point, d);
  const double f[2] = {view.fx, view.fy}, c[2] = {view.cx, view.cy};
  Sight sight;
  for (int i = 0; i < 2; ++i) {
    sight.u[i] = f[i] * point[i] + c[i];
    sight.j[i][0] = f[i] * d[i][0] * iz;
    sight.j[i][1] = f[i] * d[i][1] * iz;
    sight.j[i][2] = -(sight.j[i][0] * x + sight.j[i][1] * y);
  }
  sight.seen = before & (x * x + y * y < lens.limit * lens.limit);
  return sight;
}

// OpenCV's fisheye: the angle t from the axis becomes t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8).
SB_APART Sight see_fisheye(const View& view, const D (&q)[3]) {
  const double* k = view.lens.radial;
  const D r2 = q[0] * q[0] + q[1] * q[1];
  const D d2 = r2 + q[2] * q[2];
  const DMask axis = r2 < 1e-16 * d2;
  const D r2_safe = d_select(axis, 1e-16 * d2 + 1e-300, r2);
  const D r = d_sqrt(r2_safe);
  const D t = d_atan2(r, q[2]);
  const D t2 = t * t;
  const D bent = t * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
  const D slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])));
  const D ratio = bent / r;
  const D by_z = -slope / d2;                         // d ratio / d z
  const D by_r = (-by_z * q[2] - ratio) / r2_safe;    // (d ratio / d r) / r
  const double f[2] = {view.fx, view.fy}, c[2] = {view.cx, view.cy};
  Sight sight;
  for (int i = 0; i < 2; ++i) {
    sight.u[i] = f[i] * q[i] * ratio + c[i];
    sight.j[i][i] = f[i] * (ratio + q[i] * q[i] * by_r);
    sight.j[i][1 - i] = f[i] * q[0] * q[1] * by_r;
    sight.j[i][2] = f[i] * q[i] * by_z;
  }
  sight.seen = (t < view.lens.limit) & (d2 > 1e-12);
  return sight;
}

SB_APART Sight see_ortho(const View& view, const D (&q)[3]) {
  Sight sight;
  sight.u[0] = static_cast<double>(view.fx) * q[0] + static_cast<double>(view.cx);
  sight.u[1] = static_cast<double>(view.fy) * q[1] + static_cast<double>(view.cy);
  for (int i = 0; i < 2; ++i) {
    for (int k = 0; k < 3; ++k) {
      sight.j[i][k] = wide(i != k ? 0.0 : static_cast<double>(i == 0 ? view.fx : view.fy));
    }
  }
  sight.seen = q[2] == q[2];
  return sight;
}

SB_INLINE Sight see(const View& view, const D (&q)[3]) {
  switch (view.lens.model) {
    case CameraModel::fisheye:
      return see_fisheye(view, q);
    case CameraModel::ortho:
      return see_ortho(view, q);
    default:
      return see_pinhole(view, q);
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
