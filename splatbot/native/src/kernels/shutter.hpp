// SPDX-License-Identifier: Apache-2.0
// Points seen by a camera that moves while it reads line after line, and the gradients of its motion.
#pragma once

#include "sight.hpp"

namespace splatbot::SPLATBOT_KERNELS {

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

// State of a rolling shutter at the readout time s of a point.
struct Reading {
  D s, r[9], turned[3];  // time, rotation since s = 0, and the point turned by it about the pivot
  D whole[2][3];         // derivative of the pixel by the point in the camera frame of that time
  D by_line[2];          // derivative of the pixel by its line, were that shifted
  D line;                // pixel coordinate along which lines are read
};

// Projects through a rolling shutter: the pose is that of the pixel's readout time, which depends on the pose.
// Newton's method finds the time; the derivative is that of the implicit function.
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

}  // namespace splatbot::SPLATBOT_KERNELS
