// SPDX-License-Identifier: Apache-2.0
// EWA projection of W Gaussians at once, shared by the forward and backward passes.
#pragma once

#include "lens.hpp"
#include "simd.hpp"
#include "splatbot/kernels.hpp"

namespace splatbot::SPLATBOT_KERNELS {

inline constexpr float kHalfLog2e = 0.72134752044448170F;   // log2(e) / 2
inline constexpr float kRootHalfLog2e = 0.84932180028801904F;
inline constexpr float kZeroQuat = 1e-30F;  // a quaternion whose largest entry is below has no direction

struct GaussianLanes {
  F mean[3];  // less the view's origin
  F quat[4], scale[3];
  F covar[6];  // upper triangle, row by row; given in place of the two above, or not
};

struct CameraLanes {
  F r[9], t[3], origin[3], fx, fy, cx, cy, slope_min[2], slope_max[2];

  SB_INLINE explicit CameraLanes(const View& view) {
    for (int i = 0; i < 9; ++i) {
      r[i] = set1(view.rotation[i]);
    }
    for (int i = 0; i < 3; ++i) {
      t[i] = set1(view.translation[i]);
      origin[i] = set1(view.origin[i]);
    }
    fx = set1(view.fx);
    fy = set1(view.fy);
    cx = set1(view.cx);
    cy = set1(view.cy);
    const auto width = static_cast<float>(view.width);
    const auto height = static_cast<float>(view.height);
    const float margin_x = kFovMargin * 0.5F * width / view.fx;
    const float margin_y = kFovMargin * 0.5F * height / view.fy;
    slope_min[0] = set1(-(view.cx / view.fx + margin_x));
    slope_max[0] = set1((width - view.cx) / view.fx + margin_x);
    slope_min[1] = set1(-(view.cy / view.fy + margin_y));
    slope_max[1] = set1((height - view.cy) / view.fy + margin_y);
  }
};

struct Projected {
  F p[3];                   // in the camera frame
  F slope[2];               // x/z, y/z, clamped to the widened field of view
  M slope_free[2];          // where they are not clamped
  F jx, jy;                 // fx/z, fy/z
  F norm;                   // of the quaternion, 1 for a zero one
  M quat_zero;
  F unit[4];                // unit quaternion
  F rotation[9];            // of the Gaussian
  F a[9];                   // camera rotation x Gaussian rotation
  // Given a covariance, a is the camera rotation alone.
  F rows[2][3];             // a[0] - slope x a[2] and a[1] - slope y a[2]
  F m[2][3];                // root of the 2D covariance: j x rows x scale; of a covariance: (covariance j rows)^T
  F s00, s11, det_sharp;    // 2D covariance before the blur
  F c00, c01, c11, det;     // 2D covariance, blurred
  F mx, my;                 // [px]
};

SB_INLINE F dot3(const F* a, const F* b) { return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2])); }

SB_INLINE void rotate_gaussian(const GaussianLanes& g, const CameraLanes& cam, Projected& o) {
  // By the largest entry first: the squares of 1e-20 and 1e20 leave the range of a float.
  F largest = set1(0.0F);
  for (int i = 0; i < 4; ++i) {
    largest = max(largest, max(g.quat[i], -g.quat[i]));
  }
  o.quat_zero = largest < set1(kZeroQuat);
  largest = select(o.quat_zero, set1(1.0F), largest);
  const F shrink = set1(1.0F) / largest;
  F q[4];
  for (int i = 0; i < 4; ++i) {
    q[i] = g.quat[i] * shrink;
  }
  const F length = sqrt(fma(q[0], q[0], fma(q[1], q[1], fma(q[2], q[2], q[3] * q[3]))));
  const F inverse = set1(1.0F) / select(o.quat_zero, set1(1.0F), length);
  o.norm = largest * select(o.quat_zero, set1(1.0F), length);
  for (int i = 0; i < 4; ++i) {
    o.unit[i] = select(o.quat_zero, set1(i == 0 ? 1.0F : 0.0F), q[i] * inverse);
  }
  const F w = o.unit[0], x = o.unit[1], y = o.unit[2], z = o.unit[3];
  const F one = set1(1.0F), two = set1(2.0F);
  o.rotation[0] = fnma(two, fma(y, y, z * z), one);
  o.rotation[1] = two * fnma(w, z, x * y);
  o.rotation[2] = two * fma(w, y, x * z);
  o.rotation[3] = two * fma(w, z, x * y);
  o.rotation[4] = fnma(two, fma(x, x, z * z), one);
  o.rotation[5] = two * fnma(w, x, y * z);
  o.rotation[6] = two * fnma(w, y, x * z);
  o.rotation[7] = two * fma(w, x, y * z);
  o.rotation[8] = fnma(two, fma(x, x, y * y), one);
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      o.a[3 * i + j] = fma(cam.r[3 * i], o.rotation[j],
                           fma(cam.r[3 * i + 1], o.rotation[3 + j], cam.r[3 * i + 2] * o.rotation[6 + j]));
    }
  }
}

SB_INLINE void from_origin(const CameraLanes& cam, F (&mean)[3]) {
  for (int i = 0; i < 3; ++i) {
    mean[i] = mean[i] - cam.origin[i];
  }
}

SB_INLINE void project_center(const GaussianLanes& g, const CameraLanes& cam, Projected& o) {
  for (int i = 0; i < 3; ++i) {
    o.p[i] = fma(cam.r[3 * i], g.mean[0], fma(cam.r[3 * i + 1], g.mean[1], fma(cam.r[3 * i + 2], g.mean[2], cam.t[i])));
  }
}

// (l11 l21; 0 l22) of Record.
struct Root {
  F l11, l21, l22;
  F sy;  // standard deviation in y [px]
};

SB_INLINE Root root_of_inverse(const Projected& o) {
  Root r;
  r.sy = sqrt(o.c11);
  const F inverse = set1(1.0F) / r.sy;
  r.l22 = set1(kRootHalfLog2e) * inverse;
  r.l11 = set1(kRootHalfLog2e) * r.sy / sqrt(o.det);
  r.l21 = -(r.l11 * o.c01 * inverse * inverse);
  return r;
}

// The camera's linearisation about the centre; lanes at z <= 0 hold no meaning.
SB_INLINE void linearize(const CameraLanes& cam, Projected& o) {
  const F inverse_z = set1(1.0F) / o.p[2];
  o.jx = cam.fx * inverse_z;
  o.jy = cam.fy * inverse_z;
  o.mx = fma(o.jx, o.p[0], cam.cx);
  o.my = fma(o.jy, o.p[1], cam.cy);
  for (int i = 0; i < 2; ++i) {
    const F free = o.p[i] * inverse_z;
    o.slope[i] = clamp(free, cam.slope_min[i], cam.slope_max[i]);
    o.slope_free[i] = (free >= cam.slope_min[i]) & (free <= cam.slope_max[i]);
  }
}

// Two rows of the linearisation, in the frame of the columns of a, and their cross product (a is orthonormal). A pinhole's
// are without its scale j; of other cameras j is 1.
template <Projection P>
SB_INLINE void rows_of(const Affine& lens, Projected& o, F (&normal)[3]) {
  for (int k = 0; k < 3; ++k) {
    if constexpr (P == Projection::pinhole) {
      o.rows[0][k] = fnma(o.slope[0], o.a[6 + k], o.a[k]);
      o.rows[1][k] = fnma(o.slope[1], o.a[6 + k], o.a[3 + k]);
      normal[k] = fma(o.slope[0], o.a[k], fma(o.slope[1], o.a[3 + k], o.a[6 + k]));
    } else {
      const auto along = [&](const F (&v)[3]) { return fma(v[0], o.a[k], fma(v[1], o.a[3 + k], v[2] * o.a[6 + k])); };
      o.rows[0][k] = along(lens.j[0]);
      o.rows[1][k] = along(lens.j[1]);
      normal[k] = along(lens.normal);
    }
  }
}

template <Projection P>
SB_INLINE void spread_of_axes(const GaussianLanes& g, const CameraLanes& cam, const Affine& lens, Projected& o) {
  rotate_gaussian(g, cam, o);
  F normal[3];
  rows_of<P>(lens, o, normal);
  for (int k = 0; k < 3; ++k) {
    o.m[0][k] = o.jx * o.rows[0][k] * g.scale[k];
    o.m[1][k] = o.jy * o.rows[1][k] * g.scale[k];
  }
  o.s00 = dot3(o.m[0], o.m[0]);
  o.s11 = dot3(o.m[1], o.m[1]);
  o.c01 = dot3(o.m[0], o.m[1]);
  // det(m m^T) as the sum of squared minors (Cauchy-Binet): s00 s11 - c01^2 loses all digits of a needle.
  const F area = o.jx * o.jy;
  const F n0 = area * normal[0] * g.scale[1] * g.scale[2];
  const F n1 = area * normal[1] * g.scale[0] * g.scale[2];
  const F n2 = area * normal[2] * g.scale[0] * g.scale[1];
  o.det_sharp = fma(n0, n0, fma(n1, n1, n2 * n2));
}

// a b - c d without cancellation where fma() rounds once (Kahan).
SB_INLINE F minor(F a, F b, F c, F d) {
  const F cd = c * d;
  return fms(a, b, cd) + fnma(c, d, cd);
}

template <Projection P>
SB_INLINE void spread_of_covar(const GaussianLanes& g, const CameraLanes& cam, const Affine& lens, Projected& o) {
  for (int i = 0; i < 9; ++i) {
    o.a[i] = cam.r[i];
  }
  F normal[3];
  rows_of<P>(lens, o, normal);
  const F* v = g.covar;
  F b[2][3];
  for (int k = 0; k < 3; ++k) {
    b[0][k] = o.jx * o.rows[0][k];
    b[1][k] = o.jy * o.rows[1][k];
  }
  for (int i = 0; i < 2; ++i) {
    o.m[i][0] = fma(v[0], b[i][0], fma(v[1], b[i][1], v[2] * b[i][2]));
    o.m[i][1] = fma(v[1], b[i][0], fma(v[3], b[i][1], v[4] * b[i][2]));
    o.m[i][2] = fma(v[2], b[i][0], fma(v[4], b[i][1], v[5] * b[i][2]));
  }
  o.s00 = dot3(b[0], o.m[0]);
  o.s11 = dot3(b[1], o.m[1]);
  o.c01 = dot3(b[0], o.m[1]);
  // det(B V B^T) = n^T adj(V) n with n the cross product of B's rows: the same sum of minors as above.
  const F n[3] = {normal[0], normal[1], normal[2]};
  const F adj[6] = {minor(v[3], v[5], v[4], v[4]), minor(v[2], v[4], v[1], v[5]), minor(v[1], v[4], v[2], v[3]),
                    minor(v[0], v[5], v[2], v[2]), minor(v[1], v[2], v[0], v[4]), minor(v[0], v[3], v[1], v[1])};
  const F t[3] = {fma(adj[0], n[0], fma(adj[1], n[1], adj[2] * n[2])),
                  fma(adj[1], n[0], fma(adj[3], n[1], adj[4] * n[2])),
                  fma(adj[2], n[0], fma(adj[4], n[1], adj[5] * n[2]))};
  const F area = o.jx * o.jy;
  o.det_sharp = max(area * area * dot3(n, t), set1(0.0F));
}

SB_INLINE void blur(F eps2d, Projected& o) {
  o.c00 = o.s00 + eps2d;
  o.c11 = o.s11 + eps2d;
  o.det = fma(eps2d, o.s00 + o.s11 + eps2d, o.det_sharp);
}

// Everything after project_center(); lanes at z <= 0 hold no meaning.
template <Projection P>
SB_INLINE void project_rest(const GaussianLanes& g, const CameraLanes& cam, F eps2d, bool of_covar, Projected& o,
                            Affine& lens) {
  if constexpr (P == Projection::pinhole) {
    linearize(cam, o);
  } else {
    lens = affine_of<P>(o.p, cam.fx, cam.fy);
    o.mx = lens.mx + cam.cx;
    o.my = lens.my + cam.cy;
    o.jx = o.jy = set1(1.0F);
  }
  if (of_covar) {
    spread_of_covar<P>(g, cam, lens, o);
  } else {
    spread_of_axes<P>(g, cam, lens, o);
  }
  blur(eps2d, o);
}

// Squared factor on the opacity that makes up for the area the blur adds (Mip-Splatting, Yu et al. 2024, eq. 9).
SB_INLINE F antialias_squared(const Projected& o) {
  return max(o.det_sharp / o.det, set1(kMinAntialias * kMinAntialias));
}

}  // namespace splatbot::SPLATBOT_KERNELS
