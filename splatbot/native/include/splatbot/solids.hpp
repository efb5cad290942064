// SPDX-License-Identifier: Apache-2.0
// How the collision field keeps its Gaussians: n-sigma ellipsoids in leaves of 16, under a tree of boxes, 16 to a node.
#pragma once

#include <cstdint>

namespace splatbot {

inline constexpr int kFan = 16;  // ellipsoids to a leaf, children to a node
inline constexpr float kBlockEdge = 0.125F;  // [m]; where a mean lies says which block it belongs to

// Sixteen ellipsoids, each quantity contiguous over them. Rotation and semi-axes are kept apart: a packed inverse
// covariance in float32 loses flat ones. Unused lanes repeat lane 0 with an id of -1.
struct alignas(64) SolidLeaf {
  float mean[3][kFan];  // world [m], bit for bit as the model holds them
  float quat[4][kFan];  // unit, wxyz
  float axes[3][kFan];  // semi-axes of the n-sigma ellipsoid [m], rounded up
  std::int32_t id[kFan];
};

// The same in less memory; see packing.hpp.
struct alignas(32) PackedLeaf {
  std::uint16_t mean[3][kFan];  // from the block's corner, in steps
  std::uint32_t turn[kFan];     // three components of the quaternion, 10 bits each, then which is left out
  std::uint32_t axes[kFan];     // 10 bits each
  std::int32_t id[kFan];
};

// Boxes around the ellipsoids below each child, rounded outwards. The semi-extents of one ellipsoid's box are at most
// `reach`. A child is a node, or ~(a leaf) in a block's tree, or ~(a block) in the top tree.
struct alignas(64) SolidNode {
  float low[3][kFan];
  float high[3][kFan];
  float reach[3][kFan];
  std::int32_t child[kFan];
};

inline constexpr float kCoverRounding = 4e-6F;

// For each child of a node, a bound in the metric of `whiten`, a triangle of rows. A point's distance from `center`
// less `radius` is at most its
  // distance from any ellipsoid below. Each distance is in the ellipsoid's own metric (1 on its surface).
struct alignas(64) SolidCover {
  float center[3][kFan];  // world [m]
  float whiten[6][kFan];  // (0,0), (1,0), (1,1), (2,0), (2,1), (2,2)
  float radius[kFan];
  float thin[kFan];  // [1/m], one over the least semi-axis below: effect of a metre of rounding
};

// Covers of a field's nodes, in the order of the nodes; an array for each block.
struct SolidCoversView {
  const SolidCover* top;
  const SolidCover* const* blocks;
};

struct SolidBlockView {
  const SolidNode* nodes;  // the first is the root
  const SolidLeaf* leaves;
  const PackedLeaf* packed;  // in place of leaves, or null
  float corner[3];           // of the packed means [m]
};

// Proven lower bounds of the distance from any point of a voxel to any ellipsoid, as squares of voxels.
struct BoundGridView {
  const std::uint8_t* bound;  // (nz, ny, nx), null if there is no grid
  std::int32_t size[3];       // nx, ny, nz
  float origin[3];
  float voxel, per_voxel;  // [m], [1/m]
};

// The part of a field that the kernels read.
struct SolidsView {
  const SolidNode* top;  // the first is the root; null if there is no Gaussian
  const SolidBlockView* blocks;
  BoundGridView grid;
  float n_sigma;
};

}  // namespace splatbot
