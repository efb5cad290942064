// SPDX-License-Identifier: Apache-2.0
// Blocks of the collision field: sorting into them, their leaves and their trees.
#pragma once

#include <memory>
#include <span>
#include <vector>

#include "splatbot/field.hpp"

namespace splatbot {

// One Gaussian as a leaf keeps it.
struct SolidItem {
  std::uint64_t key;  // block, then the place in it along a Morton curve
  float mean[3], quat[4], axes[3];
  std::int32_t id;
};

inline constexpr int kPlaceBits = 21;
inline std::uint64_t block_key(std::uint64_t key) { return key >> kPlaceBits; }

std::vector<SolidItem> make_items(const Solids& solids, float n_sigma);
void append_items(const SolidBlock& block, std::vector<SolidItem>& items);

// By key, then by id.
void sort_items(std::vector<SolidItem>& items);

std::shared_ptr<const SolidBlock> make_block(std::span<const SolidItem> items);

// A tree over boxes: nodes with the root first; leaf i is child ~i.
struct SolidBox {
  float low[3], high[3], reach[3];
};
std::vector<SolidNode> make_tree(std::span<const SolidBox> boxes);
SolidBox hull(std::span<const SolidBox> boxes);

// The box of one ellipsoid, rounded outwards.
SolidBox box_of(const SolidLeaf& leaf, int lane);
void axes_of(const SolidLeaf& leaf, int lane, float axes[9]);  // columns: unit vectors of the semi-axes

}  // namespace splatbot
