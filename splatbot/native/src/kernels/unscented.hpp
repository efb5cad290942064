// SPDX-License-Identifier: Apache-2.0
// Projection of Gaussians through distorted lenses and rolling shutters by the unscented transform (Wu et al. 2024,
// 3DGUT): seven sigma points, the centre and two on each axis, are projected exactly. In double: the points lie a
// fraction of a standard deviation apart, and what counts are second differences of their pixels.
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

// When the shutter reads a pixel, -1/2..1/2 between the first line's centre and the last's, and its derivative.
struct ShutterTime {
  int axis;       // of the pixel: 0 x, 1 y
  double slope;   // 0 in an image of one line
  double offset;  // time at pixel coordinate 0

  SB_INLINE explicit ShutterTime(const View& view) {
    const Shutter shutter = view.lens.shutter;
    axis = shutter == Shutter::left_to_right || shutter == Shutter::right_to_left ? 0 : 1;
    const bool backwards = shutter == Shutter::bottom_to_top || shutter == Shutter::right_to_left;
    const int lines = axis == 0 ? view.width : view.height;
    slope = lines > 1 ? (backwards ? -1.0 : 1.0) / (lines - 1) : 0.0;
    offset = lines > 1 ? -slope * 0.5 * lines : -0.5;  // one line is read at the start
  }
};

// The rotation by the vector s x turn, and its coefficients sin(a)/a and (1 - cos(a))/a^2, by series: a <= pi/2.
SB_INLINE void turn_by(const Lens& lens, D s, D (&r)[9]) {
  const double* w = lens.turn;
  const double w2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
  const D a2 = s * s * w2;
  D sine = wide(1.0), versine = wide(1.0);
  for (int n = 10; n >= 1; --n) {
    sine = 1.0 - sine * a2 / (2.0 * n * (2.0 * n + 1.0));
    versine = 1.0 - versine * a2 / ((2.0 * n + 1.0) * (2.0 * n + 2.0));
  }
  const D a = sine * s, b = 0.5 * versine * s * s;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      r[3 * i + j] = b * (w[i] * w[j]) + (i == j ? 1.0 - b * w2 : wide(0.0));
    }
  }
  r[1] -= a * w[2];
  r[2] += a * w[1];
  r[3] += a * w[2];
  r[5] -= a * w[0];
  r[6] -= a * w[1];
  r[7] += a * w[0];
}

// What a point seen through a rolling shutter depends on besides the point, at the time s it was read.
struct Reading {
  D s, r[9], turned[3];  // time, rotation since s = 0, and the point turned by it about the pivot
  D whole[2][3];         // derivative of the pixel by the point in the camera frame of that time
  D by_line[2];          // derivative of the pixel by its line, were that shifted
  D line;                // pixel coordinate along which lines are read
};

// Through a shutter that reads line after line: the pose is that of the time at which the pixel, which depends on the
// pose, is read. Newton's method on the time; the derivative is that of the implicit function.
SB_APART Sight see_rolling(const View& view, const D (&p)[3], Reading* kept) {
  constexpr int kSteps = 8;
  const Lens& lens = view.lens;
  const ShutterTime time(view);
  D s = wide(0.0);
  for (int step = 0;; ++step) {
    D r[9], turned[3], q[3], speed[3];
    turn_by(lens, s, r);
    for (int i = 0; i < 3; ++i) {
      turned[i] = wide(0.0);
      for (int k = 0; k < 3; ++k) {
        turned[i] += r[3 * i + k] * (p[k] - lens.pivot[k]);
      }
      q[i] = turned[i] + lens.pivot[i] + s * lens.step[i];
    }
    for (int i = 0; i < 3; ++i) {
      const int j = (i + 1) % 3, k = (i + 2) % 3;
      speed[i] = lens.turn[j] * turned[k] - lens.turn[k] * turned[j] + lens.step[i];
    }
    Sight sight = see(view, q);
    D drift[2];  // d pixel / d time
    for (int i = 0; i < 2; ++i) {
      drift[i] = sight.j[i][0] * speed[0] + sight.j[i][1] * speed[1] + sight.j[i][2] * speed[2];
    }
    const D read = time.offset + time.slope * sight.u[time.axis];
    const D bounded = d_clamp(read, -0.5, 0.5);
    const D slope = d_select((read > -0.5) & (read < 0.5), wide(time.slope), wide(0.0));
    // A camera that outruns its own shutter has no single answer: the floor keeps the iteration bounded.
    constexpr double kLeastSlope = 0.1;
    D lag = 1.0 - slope * drift[time.axis];
    lag = d_select(lag < kLeastSlope, wide(kLeastSlope), lag);
    if (step == kSteps) {
      D along[3];  // d time / d turned point
      for (int k = 0; k < 3; ++k) {
        along[k] = slope * sight.j[time.axis][k] / lag;
      }
      for (int i = 0; i < 2; ++i) {
        D whole[3];
        for (int k = 0; k < 3; ++k) {
          whole[k] = sight.j[i][k] + drift[i] * along[k];
        }
        for (int k = 0; k < 3; ++k) {
          sight.j[i][k] = whole[0] * r[k] + whole[1] * r[3 + k] + whole[2] * r[6 + k];
        }
        if (kept != nullptr) {
          std::memcpy(kept->whole[i], whole, sizeof(whole));
          kept->by_line[i] = drift[i] * slope / lag;
        }
      }
      if (kept != nullptr) {
        kept->s = s;
        std::memcpy(kept->r, r, sizeof(r));
        std::memcpy(kept->turned, turned, sizeof(turned));
        kept->line = sight.u[time.axis];
      }
      return sight;
    }
    s = d_clamp(s + (bounded - s) / lag, -0.5, 0.5);
  }
}

// Gradients of a rolling shutter's turn, step and pivot, of the focal length and the principal point across its lines.
struct MotionGradient {
  D turn[3], step[3], pivot[3], focal, center;
};

// From the gradient to a pixel. The rotation by s turn changes by s J dturn, with J the left Jacobian of SO(3) (Sola et
// al. 2018, eq. 145), by series: the angle is at most pi/4.
SB_APART void pull_back_reading(const View& view, const Reading& at, D u0, D u1, MotionGradient& to) {
  const Lens& lens = view.lens;
  D g[3], back[3], tau[3];
  for (int k = 0; k < 3; ++k) {
    g[k] = u0 * at.whole[0][k] + u1 * at.whole[1][k];
  }
  for (int k = 0; k < 3; ++k) {
    back[k] = at.r[k] * g[0] + at.r[3 + k] * g[1] + at.r[6 + k] * g[2];
    to.pivot[k] += g[k] - back[k];
    to.step[k] += at.s * g[k];
  }
  const double* w = lens.turn;
  const D a2 = at.s * at.s * (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
  D versine = wide(1.0), excess = wide(1.0);  // 2 (1 - cos a) / a^2, 6 (a - sin a) / a^3
  for (int n = 10; n >= 1; --n) {
    versine = 1.0 - versine * a2 / ((2.0 * n + 1.0) * (2.0 * n + 2.0));
    excess = 1.0 - excess * a2 / ((2.0 * n + 2.0) * (2.0 * n + 3.0));
  }
  D once[3], twice[3];
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    tau[i] = at.turned[j] * g[k] - at.turned[k] * g[j];
  }
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    once[i] = w[j] * tau[k] - w[k] * tau[j];
  }
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    twice[i] = w[j] * once[k] - w[k] * once[j];
    to.turn[i] += at.s * (tau[i] - 0.5 * versine * at.s * once[i] + excess / 6.0 * at.s * at.s * twice[i]);
  }
  const ShutterTime time(view);
  const double c = static_cast<double>(time.axis == 0 ? view.cx : view.cy);
  const double f = static_cast<double>(time.axis == 0 ? view.fx : view.fy);
  const D shifted = u0 * at.by_line[0] + u1 * at.by_line[1];
  to.focal += shifted * (at.line - c) / f;
  to.center += shifted;
}

struct SigmaPoints {
  Sight center, plus[3], minus[3];
  D offset[3][3];  // axis, then camera frame
  D mean[2];       // of the pixels, from the centre's
  DMask seen;
};

// `readings`: of the centre and of the points ahead and behind on each axis; null if not wanted.
SB_APART SigmaPoints sigma_points(const View& view, const GaussianLanes& g, const Projected& o, int half,
                                  Reading* readings) {
  const Lens& lens = view.lens;
  const bool rolling = lens.shutter != Shutter::global;
  SigmaPoints s;
  D p[3];  // Projected::p has lost digits that count where a point is close to the camera
  const D mean[3] = {widen(g.mean[0], half), widen(g.mean[1], half), widen(g.mean[2], half)};
  for (int c = 0; c < 3; ++c) {
    const float* row = view.rotation + 3 * c;
    p[c] = static_cast<double>(row[0]) * mean[0] + static_cast<double>(row[1]) * mean[1] +
           static_cast<double>(row[2]) * mean[2] + static_cast<double>(view.translation[c]);
  }
  const auto look = [&](const D(&point)[3], int which) {
    return rolling ? see_rolling(view, point, readings == nullptr ? nullptr : readings + which) : see(view, point);
  };
  s.center = look(p, 0);
  s.seen = s.center.seen;
  s.mean[0] = s.mean[1] = wide(0.0);
  for (int k = 0; k < 3; ++k) {
    const D scale = lens.spread * widen(g.scale[k], half);
    D ahead[3], behind[3];
    for (int c = 0; c < 3; ++c) {
      s.offset[k][c] = scale * widen(o.a[3 * c + k], half);
      ahead[c] = p[c] + s.offset[k][c];
      behind[c] = p[c] - s.offset[k][c];
    }
    s.plus[k] = look(ahead, 1 + 2 * k);
    s.minus[k] = look(behind, 2 + 2 * k);
    s.seen = s.seen & s.plus[k].seen & s.minus[k].seen;
    for (int i = 0; i < 2; ++i) {
      s.plus[k].u[i] -= s.center.u[i];
      s.minus[k].u[i] -= s.center.u[i];
      s.mean[i] += lens.weight * (s.plus[k].u[i] + s.minus[k].u[i]);
    }
  }
  return s;
}

// As project_rest(). With e_i the pixels of the points about the centre's and m their weighted sum, the mean is the
// centre's pixel + m and the covariance weight x sum e_i e_i^T + (beta - alpha^2) m m^T: the weights sum to one, so
// the paper's large terms of opposite sign (-99 and 6 x 16.7 by default) cancel beforehand. A Gaussian of which a point
// is not seen by the lens is left out (det 0).
SB_INLINE void project_unscented(const GaussianLanes& g, const CameraLanes& cam, const View& view, F eps2d,
                                 Projected& o) {
  rotate_gaussian(g, cam, o);
  alignas(64) float mx[W], my[W], s00[W], c01[W], s11[W], sharp[W], seen[W];
  const double weight = view.lens.weight, excess = view.lens.excess;
  for (int half = 0; half < 2; ++half) {
    const SigmaPoints s = sigma_points(view, g, o, half, nullptr);
    D c[3] = {excess * s.mean[0] * s.mean[0], excess * s.mean[0] * s.mean[1], excess * s.mean[1] * s.mean[1]};
    for (int k = 0; k < 3; ++k) {
      const Sight* const pair[2] = {&s.plus[k], &s.minus[k]};
      for (const Sight* point : pair) {
        c[0] += weight * point->u[0] * point->u[0];
        c[1] += weight * point->u[0] * point->u[1];
        c[2] += weight * point->u[1] * point->u[1];
      }
    }
    const D size = c[0] * c[2] - c[1] * c[1];
    narrow(s.center.u[0] + s.mean[0], half, mx);
    narrow(s.center.u[1] + s.mean[1], half, my);
    narrow(c[0], half, s00);
    narrow(c[1], half, c01);
    narrow(c[2], half, s11);
    narrow(d_select(size > 0.0, size, wide(0.0)), half, sharp);
    narrow(d_select(s.seen, wide(1.0), wide(0.0)), half, seen);
  }
  o.mx = load(mx);
  o.my = load(my);
  o.s00 = load(s00);
  o.c01 = load(c01);
  o.s11 = load(s11);
  o.det_sharp = load(sharp);
  blur(eps2d, o);
  o.det = zero_unless(load(seen) > set1(0.5F), o.det);
}

// What a camera in motion gets besides, lane by lane.
struct MotionLanes {
  F motion[kMotionSums];
  F focal, center;  // across the lines
};

// Gradients in the camera frame: of the centre, of the Gaussian's axes (Projected::a), of its scales, and of the motion
// unless that is null; `image` holds those of its 2D mean, its depth, and of c00, twice c01 and c11.
template <class ImageGradients>
SB_INLINE void pull_back_unscented(const GaussianLanes& g, const View& view, const Projected& o,
                                   const ImageGradients& image, F (&out_p)[3], F (&out_a)[9], F (&out_scale)[3],
                                   MotionLanes* moved) {
  const Lens& lens = view.lens;
  alignas(64) float to_p[3][W], to_a[9][W], to_scale[3][W], to_motion[kMotionSums + 2][W];
  for (int half = 0; half < 2; ++half) {
    Reading readings[7];
    MotionGradient motion{};
    const SigmaPoints s = sigma_points(view, g, o, half, moved == nullptr ? nullptr : readings);
    const D mean[2] = {widen(image.mx, half), widen(image.my, half)};
    const D g00 = widen(image.g00, half), g01 = widen(image.g01, half), g11 = widen(image.g11, half);
    // d loss / d e of a point at e: weight x (mean + 2 G (e + excess x m)).
    const auto of_point = [&](const Sight& point, int which, D (&to)[3], D (&total)[2]) {
      const D e0 = point.u[0] + lens.excess * s.mean[0], e1 = point.u[1] + lens.excess * s.mean[1];
      const D u0 = lens.weight * (mean[0] + 2.0 * (g00 * e0 + g01 * e1));
      const D u1 = lens.weight * (mean[1] + 2.0 * (g01 * e0 + g11 * e1));
      total[0] += u0;
      total[1] += u1;
      for (int c = 0; c < 3; ++c) {
        to[c] = u0 * point.j[0][c] + u1 * point.j[1][c];
      }
      if (moved != nullptr) {
        pull_back_reading(view, readings[which], u0, u1, motion);
      }
    };
    D total[2] = {wide(0.0), wide(0.0)};
    D p[3] = {wide(0.0), wide(0.0), widen(image.z, half)};
    for (int k = 0; k < 3; ++k) {
      D ahead[3], behind[3];
      of_point(s.plus[k], 1 + 2 * k, ahead, total);
      of_point(s.minus[k], 2 + 2 * k, behind, total);
      D to = wide(0.0);
      const D scale = lens.spread * widen(g.scale[k], half);
      for (int c = 0; c < 3; ++c) {
        p[c] += ahead[c] + behind[c];
        narrow(scale * (ahead[c] - behind[c]), half, to_a[3 * c + k]);
        to += lens.spread * widen(o.a[3 * c + k], half) * (ahead[c] - behind[c]);
      }
      narrow(to, half, to_scale[k]);
    }
    for (int c = 0; c < 3; ++c) {
      p[c] += (mean[0] - total[0]) * s.center.j[0][c] + (mean[1] - total[1]) * s.center.j[1][c];
      narrow(p[c], half, to_p[c]);
    }
    if (moved != nullptr) {
      pull_back_reading(view, readings[0], mean[0] - total[0], mean[1] - total[1], motion);
      for (int c = 0; c < 3; ++c) {
        narrow(motion.turn[c], half, to_motion[c]);
        narrow(motion.step[c], half, to_motion[3 + c]);
        narrow(motion.pivot[c], half, to_motion[6 + c]);
      }
      narrow(motion.focal, half, to_motion[kMotionSums]);
      narrow(motion.center, half, to_motion[kMotionSums + 1]);
    }
  }
  if (moved != nullptr) {
    for (int k = 0; k < kMotionSums; ++k) {
      moved->motion[k] = load(to_motion[k]);
    }
    moved->focal = load(to_motion[kMotionSums]);
    moved->center = load(to_motion[kMotionSums + 1]);
  }
  for (int c = 0; c < 3; ++c) {
    out_p[c] = load(to_p[c]);
    out_scale[c] = load(to_scale[c]);
  }
  for (int i = 0; i < 9; ++i) {
    out_a[i] = load(to_a[i]);
  }
}

template <Projection P>
SB_INLINE void project_image(const GaussianLanes& g, const CameraLanes& cam, const View& view, F eps2d, bool of_covar,
                             Projected& o, Affine& lens) {
  if constexpr (P == Projection::unscented) {
    project_unscented(g, cam, view, eps2d, o);
  } else {
    project_rest<P>(g, cam, eps2d, of_covar, o, lens);
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
