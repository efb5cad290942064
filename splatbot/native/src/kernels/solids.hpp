// SPDX-License-Identifier: Apache-2.0
// Distances between a point and the ellipsoids of a leaf, lane by lane.
//
// Let v be the point in the ellipsoid's frame and a its semi-axes. The signed distance is the maximum over unit n of
// n.v - |a n| (support function of a convex body). Any n gives a lower bound, so the search for n may end anywhere.
//
// The best n is w/|w| with w_i = v_i / (D_i + s) and D_i = a_i^2 - min(a)^2. Here s is the root of |q(s)| = 1 with
// q_i = a_i v_i / (D_i + s). 1/|q| is concave and increasing, so Newton from the left never passes the root (Hebden 1973).
// It starts at s0 = max_i(a_i |v_i| - D_i), where one term alone is 1. It serves points inside as well (s <
// min(a)^2).
#pragma once

#include "simd.hpp"
#include "splatbot/packing.hpp"
#include "splatbot/solids.hpp"

namespace splatbot::SPLATBOT_KERNELS {

// Rounding of v, n.v and |a n| in float32, relative to |v|_1 + min(a); the sum of the roundings is below 9e-7.
inline constexpr float kRounding = 1e-6F;
// A point closer to the plane of the two longer axes than this share of the least is moved to that distance. On the
// plane itself, inside, the root is at a pole. This only selects n.
inline constexpr float kOffPlane = 2e-6F;

// A point as two floats a coordinate: 1 km from the origin it keeps its micrometres.
struct Split {
  float hi[3], lo[3];
  float slack;  // [m] between hi and the point, and the rounding error of comparing boxes with hi
};

SB_INLINE float magnitude(float x) { return x < 0.0F ? -x : x; }

SB_INLINE Split split(const double* p) {
  Split s;
  float most = 0.0F;
  for (int k = 0; k < 3; ++k) {
    s.hi[k] = static_cast<float>(p[k]);
    s.lo[k] = static_cast<float>(p[k] - static_cast<double>(s.hi[k]));
    const float m = magnitude(s.hi[k]);
    most = m > most ? m : most;
  }
  s.slack = 4e-7F * most;
  return s;
}

// A leaf, and how far packing may have moved its ellipsoids: off, and turn times the longest semi-axis.
struct LeafView {
  const SolidLeaf* leaf;
  float off, turn;
};

SB_INLINE LeafView leaf_of(const SolidBlockView& block, std::int32_t i, SolidLeaf& room) {
  if (block.packed == nullptr) {
    return {block.leaves + i, 0.0F, 0.0F};
  }
  unpack(block.packed[i], block.corner, room);
  return {&room, kPackedOff, kPackedTurn};
}

struct Local {
  F v[3];  // the point in the ellipsoids' frames
  F a[3];
  F off;  // of packing
};

SB_INLINE Local local_of(const LeafView& view, const Split& p, int at) {
  const SolidLeaf& leaf = *view.leaf;
  const F x = (set1(p.hi[0]) - load(leaf.mean[0] + at)) + set1(p.lo[0]);
  const F y = (set1(p.hi[1]) - load(leaf.mean[1] + at)) + set1(p.lo[1]);
  const F z = (set1(p.hi[2]) - load(leaf.mean[2] + at)) + set1(p.lo[2]);
  const F qw = load(leaf.quat[0] + at), qx = load(leaf.quat[1] + at), qy = load(leaf.quat[2] + at),
          qz = load(leaf.quat[3] + at);
  // R^T v = v - w t + u x t, t = 2 u x v, of the quaternion (w, u).
  const F two = set1(2.0F);
  const F tx = two * fms(qy, z, qz * y), ty = two * fms(qz, x, qx * z), tz = two * fms(qx, y, qy * x);
  Local l;
  l.v[0] = fnma(qw, tx, x) + fms(qy, tz, qz * ty);
  l.v[1] = fnma(qw, ty, y) + fms(qz, tx, qx * tz);
  l.v[2] = fnma(qw, tz, z) + fms(qx, ty, qy * tx);
  for (int k = 0; k < 3; ++k) {
    l.a[k] = load(leaf.axes[k] + at);
  }
  l.off = fma(set1(view.turn), max(l.a[0], max(l.a[1], l.a[2])), set1(view.off));
  return l;
}

SB_INLINE F absolute(F x) { return max(x, -x); }

// Squared distance to the box around each ellipsoid that has its axes.
SB_INLINE F box_squared(const Local& l) {
  const F zero = set1(0.0F);
  const F x = max(absolute(l.v[0]) - l.a[0], zero), y = max(absolute(l.v[1]) - l.a[1], zero),
          z = max(absolute(l.v[2]) - l.a[2], zero);
  return fma(x, x, fma(y, y, z * z));
}

SB_INLINE F least_axis(const Local& l) { return min(l.a[0], min(l.a[1], l.a[2])); }

// Reduction of a distance for rounding and packing.
SB_INLINE F rounding(const Local& l, F least) {
  return fma(set1(kRounding), (absolute(l.v[0]) + absolute(l.v[1])) + (absolute(l.v[2]) + least), l.off);
}

// Lower bounds of the signed distances to the ellipsoids after `Steps` Newton steps.
template <int Steps>
SB_INLINE F distance_bound(const Local& l) {
  const F least = least_axis(l);
  F v[3], D[3], b[3];
  F s = set1(0.0F);
  for (int k = 0; k < 3; ++k) {
    const F size = absolute(l.v[k]);
    const F moved = max(size, set1(kOffPlane) * l.a[k]);
    v[k] = select(l.a[k] <= least, moved, size);
    D[k] = (l.a[k] - least) * (l.a[k] + least);
    b[k] = l.a[k] * v[k];
    s = max(s, b[k] - D[k]);
  }
  F inverse[3];
  for (int i = 0; i < Steps; ++i) {
    F norm2 = set1(0.0F), slope = set1(0.0F);
    for (int k = 0; k < 3; ++k) {
      inverse[k] = reciprocal(D[k] + s);
      const F q = b[k] * inverse[k];
      const F q2 = q * q;
      norm2 = norm2 + q2;
      slope = fma(q2, inverse[k], slope);
    }
    const F step = (sqrt(norm2) - set1(1.0F)) * norm2 * reciprocal(slope);
    s = s + max(step, set1(0.0F));
  }
  F along = set1(0.0F), support = set1(0.0F), length = set1(0.0F);
  for (int k = 0; k < 3; ++k) {
    // w s: of the size of v for any size of the ellipsoid.
    inverse[k] = s / (D[k] + s);
    const F n = v[k] * inverse[k];
    const F an = l.a[k] * n;
    along = fma(n, absolute(l.v[k]), along);
    support = fma(an, an, support);
    length = fma(n, n, length);
  }
  return (along - sqrt(support)) / sqrt(length) - rounding(l, least);
}

}  // namespace splatbot::SPLATBOT_KERNELS
