// SPDX-License-Identifier: Apache-2.0
// Geometry of W surfels at once, and the response of one surfel in W pixels, shared by the forward and backward passes.
#pragma once

#include "lanes.hpp"
#include "tile.hpp"

namespace splatbot::SPLATBOT_KERNELS {

// With t0, t1 the disc's axes and p its centre in the camera frame, n = t0 x t1 and p' = p / z, the ray of the pixel at
// m + d meets the disc's plane at u = z e . (t1 x p') / (s0 D) and v = z e . (p' x t0) / (s1 D), where
// e = (dx / fx, dy / fy, 0) and D = n . p' + n . e (Cramer's rule). Unlike the homography of Huang et al. 2024, eq. 8,
// nothing here cancels for a small disc far from the image's corner.
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

// What a blend reads of a surfel, its centre from the tile's corner.
enum SurfelRow : int {
  kRowX,
  kRowY,
  kRowB,
  kRowKappa = kRowB + 4,
  kRowHx,
  kRowHy,
  kRowHitDepth,  // z kappa
  kRowZ,
  kRowLo,
  kRowNormal,
  kRowColor = kRowNormal + 3,
  kSurfelRow = kRowColor + kMaxSurfelChannels + 1,
};

template <int C>
SB_INLINE void localize(const SurfelRecord& record, const TileFrame& frame, float* row) {
  row[kRowX] = record.mx - static_cast<float>(frame.x0);
  row[kRowY] = record.my - static_cast<float>(frame.y0);
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
  h.dx = x - set1(row[kRowX]);
  h.dy = y - set1(row[kRowY]);
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
  h.alpha.u = h.u;
  h.alpha.w = h.v;
  h.alpha.power = exp2(q);
  h.alpha.alpha = min_zero_unless(q >= set1(kLog2AlphaMin), h.alpha.power, set1(kAlphaMax));
  h.alpha.left = set1(1.0F) - h.alpha.alpha;
  return h;
}

// Whether a surfel is that of the median depth unless a later one is: it counts and finds more than half of the light.
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
