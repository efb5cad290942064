// SPDX-License-Identifier: Apache-2.0
// Blocks of the collision field: sorting into them, their leaves and their trees.
#pragma once

#include <functional>
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
  std::uint32_t turn;  // of an already packed ellipsoid: packing again would turn it again
  bool packed;
};

inline constexpr int kPlaceBits = 21;
inline std::uint64_t block_key(std::uint64_t key) { return key >> kPlaceBits; }

// The lowest 21 bits of x, three places apart: three such make a place along a Morton curve.
inline std::uint64_t spread_bits(std::uint64_t x) {
  x &= 0x1fffff;
  x = (x | x << 32) & 0x1f00000000ffff;
  x = (x | x << 16) & 0x1f0000ff0000ff;
  x = (x | x << 8) & 0x100f00f00f00f00f;
  x = (x | x << 4) & 0x10c30c30c30c30c3;
  return (x | x << 2) & 0x1249249249249249;
}

SolidItem make_item(const Solids& solids, std::size_t i, float n_sigma);
std::vector<SolidItem> make_items(const Solids& solids, float n_sigma);
std::uint64_t key_of(const Solids& solids, std::size_t i, float n_sigma);  // as the item has it
void append_items(const SolidBlock& block, std::vector<SolidItem>& items);

// An item's place along the curve in its block, and which item it is.
struct SolidPlace {
  std::uint32_t place, index;
};

// One block's part of an order.
struct BlockRun {
  std::uint64_t key;
  std::size_t begin, end;
};

// The order of items by block, then by place, then by id.
std::vector<BlockRun> sort_into_blocks(std::size_t count, const std::function<std::uint64_t(std::size_t)>& key_of_item,
                                       const std::function<std::int32_t(std::size_t)>& id_of_item,
                                       std::vector<SolidPlace>& order);

std::shared_ptr<const SolidBlock> make_block(std::uint64_t key, std::span<const SolidPlace> order,
                                             const std::function<SolidItem(std::size_t)>& item_at, bool packed);

// The leaves of a block, whichever way it keeps them: in it, or unpacked into `room`.
std::size_t leaf_count(const SolidBlock& block);
const SolidLeaf& leaf_at(const SolidBlock& block, std::size_t i, SolidLeaf& room);

// A tree over boxes: nodes with the root first; leaf i is child ~i.
struct SolidBox {
  float low[3], high[3], reach[3];
};
std::vector<SolidNode> make_tree(std::span<const SolidBox> boxes);
SolidBox hull(std::span<const SolidBox> boxes);

// How far the surface of a packed block's ellipsoid may be from where it seems [m]; 0 for others.
float packing_error(const SolidBlock& block, const SolidLeaf& leaf, int lane);

// The box of one ellipsoid, rounded outwards, `more` [m] wider to every side.
SolidBox box_of(const SolidLeaf& leaf, int lane, float more);
void axes_of(const SolidLeaf& leaf, int lane, float axes[9]);  // columns: unit vectors of the semi-axes

}  // namespace splatbot
