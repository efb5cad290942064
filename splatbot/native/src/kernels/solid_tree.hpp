// SPDX-License-Identifier: Apache-2.0
// Walks through the tree of boxes, shared by every question to the collision field.
#pragma once

#include "solids.hpp"

namespace splatbot::SPLATBOT_KERNELS {

// A node of the top tree (block < 0) or of a block's tree.
struct Place {
  std::int32_t block, node;
  float bound;
};

// Children pushed by one path from root to leaf: at most 15 a level in addition to the one followed, over at most 16
// levels.
inline constexpr int kStack = 16 * kFan;

SB_INLINE const SolidNode& node_at(const SolidsView& s, Place p) {
  return p.block < 0 ? s.top[p.node] : s.blocks[p.block].nodes[p.node];
}

SB_INLINE F gap(const float* low, const float* high, int at, F x) {
  return max(max(load(low + at) - x, x - load(high + at)), set1(0.0F));
}

SB_INLINE F box_squared(const SolidNode& node, const Split& p, int at) {
  const F x = gap(node.low[0], node.high[0], at, set1(p.hi[0]));
  const F y = gap(node.low[1], node.high[1], at, set1(p.hi[1]));
  const F z = gap(node.low[2], node.high[2], at, set1(p.hi[2]));
  return fma(x, x, fma(y, y, z * z));
}

SB_INLINE void prefetch(const SolidBlockView& block, std::int32_t leaf) {
  const bool packed = block.packed != nullptr;
  const char* p = packed ? reinterpret_cast<const char*>(block.packed + leaf)
                         : reinterpret_cast<const char*>(block.leaves + leaf);
  for (int i = 0; i < (packed ? 4 : 10); ++i) {  // up to the ids
    __builtin_prefetch(p + 64 * i);
  }
}

// True if the ball of radius r around p may touch one of the leaf's ellipsoids; false is proven.
SB_INLINE bool touches(const LeafView& leaf, const Split& p, float r) {
  const float reach = (r + p.slack) * (1.0F + 1e-5F);
  for (int at = 0; at < kFan; at += W) {
    const Local l = local_of(leaf, p, at);
    const F margin = set1(reach) + rounding(l, least_axis(l));
    const M near = box_squared(l) <= margin * margin;
    if (bits(near) == 0) {
      continue;
    }
    // The ball of the least semi-axis lies inside: a sure hit costs no root.
    const F sure = set1(r) + least_axis(l);
    const F centers = fma(l.v[0], l.v[0], fma(l.v[1], l.v[1], l.v[2] * l.v[2]));
    if (bits(centers < sure * sure) != 0) {
      return true;
    }
    const M close = near & (distance_bound<2>(l) <= set1(r));
    if (bits(close) != 0 && bits(close & (distance_bound<12>(l) <= set1(r))) != 0) {
      return true;
    }
  }
  return false;
}

// The proven lower bound of the signed distance at p from the grid; negative infinity outside of it.
SB_INLINE float grid_bound(const BoundGridView& g, const Split& p) {
  if (g.bound == nullptr) {
    return -1e30F;
  }
  std::int32_t i[3];
  for (int k = 0; k < 3; ++k) {
    const float x = (p.hi[k] - g.origin[k]) * g.per_voxel;
    if (!(x >= 0.0F && x < static_cast<float>(g.size[k]))) {
      return -1e30F;
    }
    i[k] = static_cast<std::int32_t>(x);
  }
  const std::size_t at =
      (static_cast<std::size_t>(i[2]) * static_cast<std::size_t>(g.size[1]) + static_cast<std::size_t>(i[1])) *
          static_cast<std::size_t>(g.size[0]) +
      static_cast<std::size_t>(i[0]);
  return g.bound[at] == 0 ? -1e30F
                          : __builtin_sqrtf(static_cast<float>(g.bound[at])) * g.voxel * (1.0F - 1e-5F) - 2.0F * p.slack;
}

// The same, through the tree.
SB_INLINE bool tree_hit(const SolidsView& s, const Split& p, float r) {
  if (s.top == nullptr) {
    return false;
  }
  // With an infinite square, empty places of the tree, which are infinitely far, would be visited.
  const float far = (r + p.slack) * (1.0F + 1e-5F) + 1e-12F;
  const float reach = far < 1e18F ? far : 1e18F;
  const F reach2 = set1(reach * reach);
  SolidLeaf room;
  Place stack[kStack];
  int n = 0;
  stack[n++] = {-1, 0, 0.0F};
  while (n > 0) {
    const Place place = stack[--n];
    const SolidNode& node = node_at(s, place);
    std::uint32_t met = 0;
    for (int at = 0; at < kFan; at += W) {
      met |= bits(box_squared(node, p, at) <= reach2) << at;
    }
    if (place.block < 0) {
      for (; met != 0; met &= met - 1) {
        const std::int32_t child = node.child[__builtin_ctz(met)];
        stack[n++] = child >= 0 ? Place{-1, child, 0.0F} : Place{~child, 0, 0.0F};
      }
      continue;
    }
    const SolidBlockView& block = s.blocks[place.block];
    for (std::uint32_t m = met; m != 0; m &= m - 1) {
      const std::int32_t child = node.child[__builtin_ctz(m)];
      if (child < 0) {
        prefetch(block, ~child);
      }
    }
    for (; met != 0; met &= met - 1) {
      const std::int32_t child = node.child[__builtin_ctz(met)];
      if (child >= 0) {
        stack[n++] = {place.block, child, 0.0F};
      } else if (touches(leaf_of(block, ~child, room), p, r)) {
        return true;
      }
    }
  }
  return false;
}

SB_INLINE bool sphere_hit(const SolidsView& s, const Split& p, float r) {
  return grid_bound(s.grid, p) <= r && tree_hit(s, p, r);
}

}  // namespace splatbot::SPLATBOT_KERNELS
