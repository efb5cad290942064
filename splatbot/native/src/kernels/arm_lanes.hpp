// SPDX-License-Identifier: Apache-2.0
// Where the spheres of an arm are, a lane a configuration.
#pragma once

#include "simd.hpp"
#include "splatbot/arm_kernels.hpp"

namespace splatbot::SPLATBOT_KERNELS {

// Sine and cosine of x + rest, |rest| far below |x|, for |x| < 1e4. The argument is reduced by multiples of pi/2 in
// three parts; minimax polynomials on [-pi/4, pi/4] follow (absolute error below 1e-7).
SB_INLINE void sine_cosine(F x, F rest, F& sine, F& cosine) {
  const F k = floor(fma(x, set1(0.636619772F), set1(0.5F)));
  F r = fnma(k, set1(1.5703125F), x);
  r = fnma(k, set1(4.83751296997e-4F), r);
  r = fnma(k, set1(7.5497899548918e-8F), r) + rest;
  const F r2 = r * r;
  F s = fma(r2, set1(-1.9515295891e-4F), set1(8.3321608736e-3F));
  s = fma(s, r2, set1(-1.6666654611e-1F));
  s = fma(s * r2, r, r);
  F c = fma(r2, set1(2.443315711809948e-5F), set1(-1.388731625493765e-3F));
  c = fma(c, r2, set1(4.166664568298827e-2F));
  c = fma(c * r2, r2, fnma(set1(0.5F), r2, set1(1.0F)));
  const I quadrant = to_int(k) & set1(3);
  const M odd = (quadrant & set1(1)) == set1(1);
  const M flip_sine = (quadrant & set1(2)) == set1(2);
  const M flip_cosine = ((quadrant + set1(1)) & set1(2)) == set1(2);
  sine = select(odd, c, s);
  cosine = select(odd, s, c);
  sine = select(flip_sine, -sine, sine);
  cosine = select(flip_cosine, -cosine, cosine);
}

struct Pose {
  F R[9], t[3];
};

// Joint values as two floats each.
struct JointLanes {
  alignas(64) float hi[kMostJoints][W];
  alignas(64) float lo[kMostJoints][W];
};

SB_INLINE void put_joint(JointLanes& q, int joint, int lane, double value) {
  q.hi[joint][lane] = static_cast<float>(value);
  q.lo[joint][lane] = static_cast<float>(value - static_cast<double>(q.hi[joint][lane]));
}

SB_INLINE Pose base_of(const ArmView& arm) {
  Pose p;
  for (int i = 0; i < 9; ++i) {
    p.R[i] = set1(arm.base_R[i]);
  }
  for (int i = 0; i < 3; ++i) {
    p.t[i] = set1(0.0F);
  }
  return p;
}

// Poses of every link, along the world's axes but from the base's origin: small numbers keep their digits.
SB_INLINE void forward(const ArmView& arm, const JointLanes& q, Pose* link) {
  link[0] = base_of(arm);
  for (int j = 0; j < arm.joints; ++j) {
    const ArmJoint& joint = arm.joint[j];
    const Pose& from = link[j];
    Pose& to = link[j + 1];
    for (int i = 0; i < 3; ++i) {
      const F a = from.R[3 * i], b = from.R[3 * i + 1], c = from.R[3 * i + 2];
      for (int k = 0; k < 3; ++k) {
        to.R[3 * i + k] = fma(a, set1(joint.R[k]), fma(b, set1(joint.R[3 + k]), c * set1(joint.R[6 + k])));
      }
      to.t[i] = fma(a, set1(joint.t[0]), fma(b, set1(joint.t[1]), fma(c, set1(joint.t[2]), from.t[i])));
    }
    const F value = load(q.hi[j]), rest = load(q.lo[j]);
    if (joint.prismatic != 0) {
      for (int i = 0; i < 3; ++i) {
        to.t[i] = fma(to.R[3 * i + 2], value + rest, to.t[i]);
      }
      continue;
    }
    F s, c;
    sine_cosine(value, rest, s, c);
    for (int i = 0; i < 3; ++i) {
      const F x = to.R[3 * i], y = to.R[3 * i + 1];
      to.R[3 * i] = fma(c, x, s * y);
      to.R[3 * i + 1] = fms(c, y, s * x);
    }
  }
}

SB_INLINE void place(const Pose& pose, float x, float y, float z, F (&at)[3]) {
  for (int i = 0; i < 3; ++i) {
    at[i] = fma(pose.R[3 * i], set1(x), fma(pose.R[3 * i + 1], set1(y), fma(pose.R[3 * i + 2], set1(z), pose.t[i])));
  }
}

// Centres of the balls around groups and links, and of the spheres of the placed groups.
struct Placed {
  alignas(64) float at[kMostBalls][3][W];
  alignas(64) float ball[kMostJoints + 1][3][W];
  alignas(64) float pose[kMostJoints + 1][12][W];  // R and t of each link
  bool has[kMostGroups];
};

SB_INLINE void place_ball(const ArmView& arm, const Pose& pose, int i, Placed& placed) {
  F at[3];
  place(pose, arm.center[0][i], arm.center[1][i], arm.center[2][i], at);
  for (int k = 0; k < 3; ++k) {
    store(placed.at[i][k], at[k]);
  }
}

SB_INLINE void place_groups(const ArmView& arm, const Pose* link, Placed& placed) {
  F at[3];
  for (int l = 0; l <= arm.joints; ++l) {
    const float* ball = arm.enclosing + 4 * l;
    place(link[l], ball[0], ball[1], ball[2], at);
    for (int i = 0; i < 3; ++i) {
      store(placed.ball[l][i], at[i]);
      store(placed.pose[l][9 + i], link[l].t[i]);
    }
    for (int i = 0; i < 9; ++i) {
      store(placed.pose[l][i], link[l].R[i]);
    }
    for (int g = arm.link_begin[l]; g < arm.link_begin[l + 1]; ++g) {
      place_ball(arm, link[l], arm.spheres + g, placed);
      placed.has[g] = false;
    }
  }
}

// Places the spheres of a group in all lanes.
SB_INLINE void place_spheres(const ArmView& arm, const Pose* link, int group, Placed& placed) {
  if (placed.has[group]) {
    return;
  }
  placed.has[group] = true;
  for (int s = arm.group_begin[group]; s < arm.group_begin[group + 1]; ++s) {
    place_ball(arm, link[arm.group_link[group]], s, placed);
  }
}

// Places W spheres of a link from `first` on in one lane: here a lane of the answer is a sphere.
SB_INLINE void place_in_lane(const ArmView& arm, const Placed& placed, int link, int lane, int first, float (&at)[3][W]) {
  const F x = load(arm.center[0] + first), y = load(arm.center[1] + first), z = load(arm.center[2] + first);
  const auto& pose = placed.pose[link];
  for (int i = 0; i < 3; ++i) {
    const F shift = set1(pose[9 + i][lane]);
    store(at[i], fma(set1(pose[3 * i][lane]), x, fma(set1(pose[3 * i + 1][lane]), y, fma(set1(pose[3 * i + 2][lane]), z, shift))));
  }
}

SB_INLINE F squared_between(const float (&a)[3][W], const float (&b)[3][W]) {
  const F x = load(a[0]) - load(b[0]), y = load(a[1]) - load(b[1]), z = load(a[2]) - load(b[2]);
  return fma(x, x, fma(y, y, z * z));
}

}  // namespace splatbot::SPLATBOT_KERNELS
