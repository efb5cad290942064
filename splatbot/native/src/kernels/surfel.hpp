// SPDX-License-Identifier: Apache-2.0
// Geometry of W surfels at once, and the response of one surfel in W pixels, shared by the forward and backward passes.
#pragma once

#include "lanes.hpp"
#include "tile.hpp"

namespace splatbot::SPLATBOT_KERNELS {

// Let t0, t1 be the disc's axes, p its centre in the camera frame, n = t0 x t1 and p' = p / z. The ray of the pixel
// at m + d meets the disc's plane at u = z e . (t1 x p') / (s0 D) and v = z e . (p' x t0) / (s1 D). Here e = (dx /
// fx, dy / fy, 0) and D = n . p' + n . e (Cramer's rule). Unlike the homography of Huang et al. 2024, eq. 8, no
// digits cancel for a small disc far from the image's corner.
struct Surfel {
  F slope[2];          // p'
  F flip;              // -1 where n points towards the camera; all of b, n and kappa are multiplied by it
  F n[3], kappa;       // n, n . p'
  F scale[2];          // not below kLeastScale pixels
  M scale_free[2];     // where they are the given ones
  F b[4], hx, hy;      // of SurfelRecord
  F mx, my;
};

// After project_center(); lanes at z <= 0 hold no meaning.
SB_INLINE void project_surfel(const GaussianLanes& g, const CameraLanes& cam, Projected& o, Surfel& s) {
  rotate_gaussian(g, cam, o);
  const F* a = o.a;
  const F inverse_z = set1(1.0F) / o.p[2];
  s.slope[0] = o.p[0] * inverse_z;
  s.slope[1] = o.p[1] * inverse_z;
  s.n[0] = fms(a[3], a[7], a[6] * a[4]);
  s.n[1] = fms(a[6], a[1], a[0] * a[7]);
  s.n[2] = fms(a[0], a[4], a[3] * a[1]);
  s.kappa = fma(s.n[0], s.slope[0], fma(s.n[1], s.slope[1], s.n[2]));
  s.flip = select(s.kappa < set1(0.0F), set1(-1.0F), set1(1.0F));
  s.kappa = s.kappa * s.flip;
  F k[2];
  const F least = set1(kLeastScale) * o.p[2] / cam.fx;
  for (int i = 0; i < 2; ++i) {
    s.n[i] = s.n[i] * s.flip;
    const F size = max(g.scale[i], -g.scale[i]);
    s.scale_free[i] = size > least;
    s.scale[i] = max(size, least);
    k[i] = s.flip * o.p[2] / s.scale[i];
  }
  s.n[2] = s.n[2] * s.flip;
  const F ifx = set1(1.0F) / cam.fx, ify = set1(1.0F) / cam.fy;
  s.b[0] = fnma(a[7], s.slope[1], a[4]) * k[0] * ifx;
  s.b[1] = fms(a[7], s.slope[0], a[1]) * k[0] * ify;
  s.b[2] = fms(a[6], s.slope[1], a[3]) * k[1] * ifx;
  s.b[3] = fnma(a[6], s.slope[0], a[0]) * k[1] * ify;
  s.hx = s.n[0] * ifx;
  s.hy = s.n[1] * ify;
  s.mx = fma(cam.fx, s.slope[0], cam.cx);
  s.my = fma(cam.fy, s.slope[1], cam.cy);
}

// The numbers of Surfel to which a blend is sensitive. Thin and grazing discs magnify their rounding, so they are
// computed in double precision and rounded once.
struct PreciseLanes {
  alignas(64) float whole[2][W], part[2][W], slope[2][W], z[W], b[4][W], kappa[W], h[2][W], flip[W];
};

SB_INLINE void project_precisely(const F (&means)[3], const GaussianLanes& g, const View& view, PreciseLanes& out) {
  alignas(64) float mean[3][W], quat[4][W], scale[2][W];
  for (int k = 0; k < 4; ++k) {
    store(quat[k], g.quat[k]);
    store(mean[k % 3], means[k % 3]);
    store(scale[k % 2], g.scale[k % 2]);
  }
  const float* r = view.rotation;
  const double focal[2] = {view.fx, view.fy}, center[2] = {view.cx, view.cy};
  for (int i = 0; i < W; ++i) {
    double q[4], p[3], t[3][2];
    double norm = 0.0, largest = 0.0;
    for (int k = 0; k < 4; ++k) {
      q[k] = quat[k][i];
      norm += q[k] * q[k];
      const double size = q[k] < 0.0 ? -q[k] : q[k];
      largest = size > largest ? size : largest;
    }
    const bool zero = largest < static_cast<double>(kZeroQuat);
    const double two = zero ? 0.0 : 2.0 / norm;
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    const double axes[3][2] = {{1.0 - two * (y * y + z * z), two * (x * y - w * z)},
                               {two * (x * y + w * z), 1.0 - two * (x * x + z * z)},
                               {two * (x * z - w * y), two * (y * z + w * x)}};
    const double centre[3] = {static_cast<double>(mean[0][i]) - view.origin[0],
                              static_cast<double>(mean[1][i]) - view.origin[1],
                              static_cast<double>(mean[2][i]) - view.origin[2]};
    for (int k = 0; k < 3; ++k) {
      const double r0 = r[3 * k], r1 = r[3 * k + 1], r2 = r[3 * k + 2];
      p[k] = r0 * centre[0] + r1 * centre[1] + r2 * centre[2] + view.translation[k];
      t[k][0] = r0 * axes[0][0] + r1 * axes[1][0] + r2 * axes[2][0];
      t[k][1] = r0 * axes[0][1] + r1 * axes[1][1] + r2 * axes[2][1];
    }
    const double px = p[0] / p[2], py = p[1] / p[2];
    const double nx = t[1][0] * t[2][1] - t[2][0] * t[1][1];
    const double ny = t[2][0] * t[0][1] - t[0][0] * t[2][1];
    const double nz = t[0][0] * t[1][1] - t[1][0] * t[0][1];
    const double kappa = nx * px + ny * py + nz;
    const double flip = kappa < 0.0 ? -1.0 : 1.0;
    const double least = static_cast<double>(kLeastScale) * p[2] / focal[0];
    double k[2];
    for (int a = 0; a < 2; ++a) {
      const double size = scale[a][i] < 0.0F ? -scale[a][i] : scale[a][i];
      k[a] = flip * p[2] / (size > least ? size : least);
    }
    out.b[0][i] = static_cast<float>((t[1][1] - t[2][1] * py) * k[0] / focal[0]);
    out.b[1][i] = static_cast<float>((t[2][1] * px - t[0][1]) * k[0] / focal[1]);
    out.b[2][i] = static_cast<float>((t[2][0] * py - t[1][0]) * k[1] / focal[0]);
    out.b[3][i] = static_cast<float>((t[0][0] - t[2][0] * px) * k[1] / focal[1]);
    out.slope[0][i] = static_cast<float>(px);
    out.slope[1][i] = static_cast<float>(py);
    out.z[i] = static_cast<float>(p[2]);
    out.kappa[i] = static_cast<float>(flip * kappa);
    out.h[0][i] = static_cast<float>(flip * nx / focal[0]);
    out.h[1][i] = static_cast<float>(flip * ny / focal[1]);
    out.flip[i] = static_cast<float>(flip);
    const double m[2] = {px * focal[0] + center[0], py * focal[1] + center[1]};
    for (int a = 0; a < 2; ++a) {
      out.whole[a][i] = static_cast<float>(__builtin_floor(m[a]));
      out.part[a][i] = static_cast<float>(m[a] - static_cast<double>(out.whole[a][i]));
    }
  }
}

// Inputs of a blend from a surfel, with its centre relative to the tile's corner.
enum SurfelRow : int {
  kRowX,
  kRowY,
  kRowPartX,
  kRowPartY,
  kRowB,
  kRowKappa = kRowB + 4,
  kRowHx,
  kRowHy,
  kRowHitDepth,  // z kappa
  kRowZ,
  kRowLo,
  kRowNormal,
  kRowColor = kRowNormal + 3,
  kSurfelRow = kRowColor + kMaxSurfelChannels,
};

template <int C>
SB_INLINE void localize(const SurfelRecord& record, const TileFrame& frame, float* row) {
  row[kRowX] = record.mx - static_cast<float>(frame.x0);
  row[kRowY] = record.my - static_cast<float>(frame.y0);
  row[kRowPartX] = record.part_x;
  row[kRowPartY] = record.part_y;
  std::memcpy(row + kRowB, record.b, sizeof(record.b));
  row[kRowKappa] = record.kappa;
  row[kRowHx] = record.hx;
  row[kRowHy] = record.hy;
  row[kRowHitDepth] = record.z * record.kappa;
  row[kRowZ] = record.z;
  row[kRowLo] = record.lo;
  std::memcpy(row + kRowNormal, record.normal, sizeof(record.normal));
  std::memcpy(row + kRowColor, record.channels, C * sizeof(float));
}

struct SurfelHit {
  F dx, dy;
  F inverse;      // 1 / D
  F u, v, disc;   // disc = u^2 + v^2
  M on_disc;      // the disc's response counts, not the low-pass filter's; above lanes mean nothing elsewhere
  F depth;
  Alpha alpha;
};

// Both passes go through here, so that they decide alike.
SB_INLINE SurfelHit hit_at(F x, F y, const float* row, F near) {
  SurfelHit h;
  h.dx = x - set1(row[kRowX]) - set1(row[kRowPartX]);
  h.dy = y - set1(row[kRowY]) - set1(row[kRowPartY]);
  const F d = fma(set1(row[kRowHx]), h.dx, fma(set1(row[kRowHy]), h.dy, set1(row[kRowKappa])));
  h.inverse = set1(1.0F) / d;
  h.u = fma(set1(row[kRowB]), h.dx, set1(row[kRowB + 1]) * h.dy) * h.inverse;
  h.v = fma(set1(row[kRowB + 2]), h.dx, set1(row[kRowB + 3]) * h.dy) * h.inverse;
  h.disc = fma(h.u, h.u, h.v * h.v);
  const F point = set1(kFilter) * fma(h.dx, h.dx, h.dy * h.dy);
  const F along = set1(row[kRowHitDepth]);
  h.on_disc = (h.disc <= point) & (d > set1(0.0F)) & (along >= near * d);
  h.depth = select(h.on_disc, along * h.inverse, set1(row[kRowZ]));
  const F q = fnma(set1(kHalfLog2e), select(h.on_disc, h.disc, point), set1(row[kRowLo]));
  h.alpha = alpha_of(max(q, set1(2.0F * kLog2AlphaMin)));  // lower, exp2 may leave its range
  return h;
}

// True if a surfel is the median one unless a later one is: it contributes and receives more than half of the light.
SB_INLINE M median_candidate(const SurfelHit& h, const Step& step, F through) {
  return step.open & (h.alpha.alpha > set1(0.0F)) & (through > set1(kMedianLight));
}

// Distortion's term of one surfel: depth x sum of weights before - sum of weight x depth before, and its sign.
struct Lag {
  F lag, sign;
};
SB_INLINE Lag lag_at(F depth, F before, F moment) {
  const F lag = fms(depth, before, moment);
  return {lag, select(lag < set1(0.0F), set1(-1.0F), set1(1.0F))};
}

}  // namespace splatbot::SPLATBOT_KERNELS
