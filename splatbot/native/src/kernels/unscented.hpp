// SPDX-License-Identifier: Apache-2.0
// Projection of Gaussians through distorted lenses and rolling shutters by the unscented transform (Wu et al. 2024,
// 3DGUT). Seven sigma points, the centre and two on each axis, are projected exactly. It runs in double: the points
// lie a fraction of a standard deviation apart, and the result depends on second differences of their pixels.
#pragma once

#include "shutter.hpp"

namespace splatbot::SPLATBOT_KERNELS {

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

// As project_rest(). Let e_i be the points' pixels relative to the centre's and m their weighted sum. The mean is the
// centre's pixel + m, the covariance weight x sum e_i e_i^T + (beta - alpha^2) m m^T. The weights sum to one, so the
// paper's large terms of opposite sign (-99 and 6 x 16.7 by default) cancel beforehand. A Gaussian with a point out
// of the lens's view is left out (det 0).
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

// Additional state of a moving camera, lane by lane.
struct MotionLanes {
  F motion[kMotionSums];
  F focal, center;  // across the lines
};

// Gradients in the camera frame: of the centre, of the Gaussian's axes (Projected::a), of its scales. That of the
// motion is computed unless its pointer is null. `image` holds the gradients of the 2D mean, the depth, and c00,
// twice c01 and c11.
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
