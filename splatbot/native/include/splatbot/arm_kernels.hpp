// SPDX-License-Identifier: Apache-2.0
// The arm's kernels, compiled once for each instruction set; see kernels.hpp. A lane is a configuration.
#pragma once

#include <cstddef>
#include <cstdint>

#include "splatbot/solids.hpp"

namespace splatbot {

inline constexpr int kMostJoints = 16, kMostSpheres = 640, kMostPairs = 256;
inline constexpr int kGroupSize = 6;  // spheres in a group at most
inline constexpr int kMostGroups = kMostSpheres / 3 + kMostJoints + 1;  // halves of 7 have 3 or more
inline constexpr int kMostBalls = kMostSpheres + kMostGroups;
inline constexpr int kPadding = 32;  // numbers behind the last sphere that a vector may read

// From the frame of the link before to that of the joint at 0; the joint then turns about z, or moves along it.
struct ArmJoint {
  float R[9], t[3];
  std::int32_t prismatic;
};

// An arm as the kernels see it, on two levels. Small spheres decide. Balls around groups of neighbouring spheres spare
// most of the tests. The balls are numbered after the spheres: that of group g is spheres + g. Spheres and groups
// are sorted by link; link 0 is the base, link k moves with joint k - 1.
struct ArmView {
  int joints, spheres, groups, first_group;  // groups before the first are not tested against the map
  const ArmJoint* joint;
  float base_R[9];
  double base_t[3];  // of T_world_base
  const float* center[3];           // (balls + kPadding,)
  const float* radius;              // (balls + kPadding,) with the error of float32 in it
  const std::int32_t* name;         // (spheres,) the number of each by its caller
  float margin;                     // [m] more against the map
  const std::int32_t* group_begin;  // (groups + 1,) spheres of each group
  const std::int32_t* group_link;   // (groups,)
  const std::int32_t* link_begin;   // (joints + 2,) groups of each link
  const float* enclosing;           // (joints + 1, 4): a ball around each link's spheres; radius < 0: none
  int pairs;
  const std::int32_t* pair;  // (pairs, 2): links a < b that may not touch
  const float* reach;        // (balls, joints): farthest of its centre from each joint's axis; 1 for prismatic joints
  const float* link_reach;   // (joints + 1, joints): the farthest of each link's spheres
};

// Result of checking a configuration or an edge.
enum ArmVerdict : std::int32_t {
  kArmFree = -1,
  // 0 to spheres - 1: that sphere may touch the map. From kArmSelf on: that pair of links may touch.
  kArmSelf = 1 << 16,
};

struct ArmEdge {
  std::int32_t verdict;
  float at;              // where on the edge, 0..1; of a free edge 1
  std::int32_t checked;  // configurations looked at
};

struct ArmKernels {
  // Verdicts of configurations (C, joints). A field of null: self-collision alone.
  void (*configurations)(const ArmView&, const SolidsView* field, const double* q, std::size_t begin, std::size_t end,
                         std::int32_t* verdict);
  // Certifies straight edges in joint space from `from` to `to` (E, joints): every configuration on a certified edge
  // is free. An edge is rejected where a sphere has less than `eps` [m] of clearance, which bounds the bisection.
  void (*certify)(const ArmView&, const SolidsView* field, const double* from, const double* to, float eps,
                  std::size_t begin, std::size_t end, ArmEdge* out);
  // Edges by `samples` configurations each, evenly spaced with both ends.
  void (*sample)(const ArmView&, const SolidsView* field, const double* from, const double* to, int samples,
                 std::size_t begin, std::size_t end, ArmEdge* out);
  // Centres (C, spheres, 3) of the spheres in float32.
  void (*centers)(const ArmView&, const double* q, std::size_t begin, std::size_t end, float* out);
};

}  // namespace splatbot
