// SPDX-License-Identifier: Apache-2.0
#include "solid_blocks.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <unordered_map>

#include "splatbot/packing.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {

namespace {

constexpr int kBlockBits = 14;  // an axis: 1 km either way, beyond which blocks at the rim hold the rest
constexpr int kInBlockBits = kPlaceBits / 3;
constexpr std::uint64_t kLargeBlock = (std::uint64_t{1} << (3 * kBlockBits)) - 1;
constexpr float kSmallestAxis = 1e-9F;  // [m]; squares must not vanish
constexpr std::size_t kChunk = 4096;

constexpr float kHalfBlocks = 1 << (kBlockBits - 1);

std::uint64_t place_of(const float* mean) {
  std::uint64_t place = 0;
  for (int k = 0; k < 3; ++k) {
    const float at = mean[k] / kBlockEdge;
    constexpr float parts = 1 << kInBlockBits;
    place |= spread_bits(static_cast<std::uint64_t>(std::clamp((at - std::floor(at)) * parts, 0.0F, parts - 1.0F))) << k;
  }
  return place;
}

std::uint64_t key_of(const float* mean, float longest) {
  std::uint64_t block = 0;
  for (int k = 0; k < 3; ++k) {
    const float cell = std::floor(mean[k] / kBlockEdge);
    block |= spread_bits(static_cast<std::uint64_t>(std::clamp(cell, -kHalfBlocks, kHalfBlocks - 2.0F) + kHalfBlocks)) << k;
  }
  return (longest > kBlockEdge ? kLargeBlock : block) << kPlaceBits | place_of(mean);
}

// The corner of the cube that a mean lies in; false where a block is no cube, which cannot be packed.
bool corner_of(std::uint64_t key, const float* mean, float* corner) {
  bool cube = key != kLargeBlock;
  for (int k = 0; k < 3; ++k) {
    const float cell = std::floor(mean[k] / kBlockEdge);
    cube = cube && std::abs(cell) < kHalfBlocks - 2.0F;
    corner[k] = cell * kBlockEdge;
  }
  return cube;
}

std::uint32_t packed_turn(const float* quat) {
  std::uint32_t which = 0;
  for (std::uint32_t k = 1; k < 4; ++k) {
    which = std::abs(quat[k]) > std::abs(quat[which]) ? k : which;
  }
  const float sign = quat[which] < 0.0F ? -1.0F : 1.0F;
  std::uint32_t turn = which << 30, shift = 0;
  for (std::uint32_t k = 0; k < 4; ++k) {
    if (k != which) {
      const float code = std::round(sign * quat[k] / kTurnStep + 511.5F);
      turn |= static_cast<std::uint32_t>(std::clamp(code, 0.0F, 1023.0F)) << shift;
      shift += 10;
    }
  }
  return turn;
}

// Rounded up.
std::uint32_t packed_axis(float axis) {
  const float x = std::max(axis, kPackedLeast);
  std::uint32_t bits;
  std::memcpy(&bits, &x, sizeof(bits));
  return (bits - kAxisBase + (1U << 17) - 1U) >> 17;
}

void pack_lane(PackedLeaf& leaf, int lane, const SolidItem& item, const float* corner, std::int32_t id) {
  leaf.axes[lane] = 0;
  for (int k = 0; k < 3; ++k) {
    const float steps = std::round((item.mean[k] - corner[k]) / kPackedStep);
    leaf.mean[k][lane] = static_cast<std::uint16_t>(std::clamp(steps, 0.0F, 65535.0F));
    leaf.axes[lane] |= packed_axis(item.axes[k]) << (10 * k);
  }
  leaf.turn[lane] = item.packed ? item.turn : packed_turn(item.quat);
  leaf.id[lane] = id;
}

// Rounded up by more than the scale and the product were rounded.
float axis_of(float scale, float n_sigma) {
  return std::max(n_sigma * scale, kSmallestAxis) * (1.0F + 4.0F * std::numeric_limits<float>::epsilon());
}

void put_lane(SolidLeaf& leaf, int lane, const SolidItem& item, std::int32_t id) {
  for (int k = 0; k < 3; ++k) {
    leaf.mean[k][lane] = item.mean[k];
    leaf.axes[k][lane] = item.axes[k];
  }
  for (int k = 0; k < 4; ++k) {
    leaf.quat[k][lane] = item.quat[k];
  }
  leaf.id[lane] = id;
}

void put_child(SolidNode& node, int lane, const SolidBox& box, std::int32_t child) {
  for (int k = 0; k < 3; ++k) {
    node.low[k][lane] = box.low[k];
    node.high[k][lane] = box.high[k];
    node.reach[k][lane] = box.reach[k];
  }
  node.child[lane] = child;
}

SolidBox nothing() {
  constexpr float kInfinity = std::numeric_limits<float>::infinity();
  SolidBox box;
  std::fill(std::begin(box.low), std::end(box.low), kInfinity);
  std::fill(std::begin(box.high), std::end(box.high), -kInfinity);
  std::fill(std::begin(box.reach), std::end(box.reach), 1e-30F);
  return box;
}

}  // namespace

SolidItem make_item(const Solids& s, std::size_t i, float n_sigma) {
  SolidItem item;
  std::memcpy(item.mean, &s.means[3 * i], sizeof(item.mean));
  double q[4], largest = 0.0, norm = 0.0;
  for (int k = 0; k < 4; ++k) {
    q[k] = static_cast<double>(s.quats[4 * i + static_cast<std::size_t>(k)]);
    largest = std::max(largest, std::abs(q[k]));
  }
  for (double& x : q) {
    x /= largest;
    norm += x * x;
  }
  norm = std::sqrt(norm);
  float longest = 0.0F;
  for (int k = 0; k < 4; ++k) {
    item.quat[k] = static_cast<float>(q[k] / norm);
  }
  for (int k = 0; k < 3; ++k) {
    item.axes[k] = axis_of(s.scales[3 * i + static_cast<std::size_t>(k)], n_sigma);
    longest = std::max(longest, item.axes[k]);
  }
  item.key = key_of(item.mean, longest);
  item.id = s.ids[i];
  item.turn = 0;
  item.packed = false;
  return item;
}

std::vector<SolidItem> make_items(const Solids& solids, float n_sigma) {
  std::vector<SolidItem> items(solids.ids.size());
  for (std::size_t i = 0; i < items.size(); ++i) {
    items[i] = make_item(solids, i, n_sigma);
  }
  return items;
}

void append_items(const SolidBlock& block, std::vector<SolidItem>& items) {
  SolidLeaf room;
  for (std::size_t l = 0; l < leaf_count(block); ++l) {
    const SolidLeaf& leaf = leaf_at(block, l, room);
    for (int lane = 0; lane < kFan; ++lane) {
      if (leaf.id[lane] < 0) {
        continue;
      }
      SolidItem item;
      for (int k = 0; k < 3; ++k) {
        item.mean[k] = leaf.mean[k][lane];
        item.axes[k] = leaf.axes[k][lane];
      }
      for (int k = 0; k < 4; ++k) {
        item.quat[k] = leaf.quat[k][lane];
      }
      item.id = leaf.id[lane];
      item.key = block.key << kPlaceBits | place_of(item.mean);
      item.packed = !block.packed.empty();
      item.turn = item.packed ? block.packed[l].turn[lane] : 0;
      items.push_back(item);
    }
  }
}

std::vector<BlockRun> sort_into_blocks(std::size_t count, const std::function<std::uint64_t(std::size_t)>& key_of_item,
                                       const std::function<std::int32_t(std::size_t)>& id_of_item,
                                       std::vector<SolidPlace>& order) {
  std::vector<std::uint64_t> keys(count);
  const auto pool = thread_pool();
  pool->run((count + kChunk - 1) / kChunk, [&](std::size_t c) {
    for (std::size_t i = c * kChunk; i < std::min(count, (c + 1) * kChunk); ++i) {
      keys[i] = key_of_item(i);
    }
  });
  std::unordered_map<std::uint64_t, std::uint32_t> slots;
  std::vector<BlockRun> runs;
  std::vector<std::uint32_t> slot_of(count);
  std::uint64_t last_key = ~std::uint64_t{0};
  std::uint32_t last = 0;
  for (std::size_t i = 0; i < count; ++i) {
    const std::uint64_t block = block_key(keys[i]);
    if (block != last_key) {  // neighbours in the map are neighbours in space more often than not
      const auto [found, added] = slots.emplace(block, static_cast<std::uint32_t>(runs.size()));
      if (added) {
        runs.push_back({block, 0, 0});
      }
      last_key = block;
      last = found->second;
    }
    slot_of[i] = last;
    ++runs[last].end;
  }
  std::size_t sum = 0;
  std::vector<std::size_t> next(runs.size());
  for (std::size_t r = 0; r < runs.size(); ++r) {
    next[r] = runs[r].begin = sum;
    sum += runs[r].end;
    runs[r].end = sum;
  }
  order.resize(count);
  for (std::size_t i = 0; i < count; ++i) {
    order[next[slot_of[i]]++] = {static_cast<std::uint32_t>(keys[i] & ((std::uint64_t{1} << kPlaceBits) - 1)),
                                 static_cast<std::uint32_t>(i)};
  }
  pool->run(runs.size(), [&](std::size_t r) {
    const auto at = [&](std::size_t i) { return order.begin() + static_cast<std::ptrdiff_t>(i); };
    std::sort(at(runs[r].begin), at(runs[r].end), [&](const SolidPlace& a, const SolidPlace& b) {
      return a.place < b.place || (a.place == b.place && id_of_item(a.index) < id_of_item(b.index));
    });
  });
  return runs;
}

std::uint64_t key_of(const Solids& s, std::size_t i, float n_sigma) {
  const float longest = std::max({s.scales[3 * i], s.scales[3 * i + 1], s.scales[3 * i + 2]});
  return key_of(&s.means[3 * i], axis_of(longest, n_sigma));
}

void axes_of(const SolidLeaf& leaf, int lane, float R[9]) {
  const float w = leaf.quat[0][lane], x = leaf.quat[1][lane], y = leaf.quat[2][lane], z = leaf.quat[3][lane];
  const float rows[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                         2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
  std::copy(std::begin(rows), std::end(rows), R);
}

std::size_t leaf_count(const SolidBlock& block) { return std::max(block.leaves.size(), block.packed.size()); }

const SolidLeaf& leaf_at(const SolidBlock& block, std::size_t i, SolidLeaf& room) {
  if (block.packed.empty()) {
    return block.leaves[i];
  }
  unpack(block.packed[i], block.corner, room);
  return room;
}

float packing_error(const SolidBlock& block, const SolidLeaf& leaf, int lane) {
  const float longest = std::max({leaf.axes[0][lane], leaf.axes[1][lane], leaf.axes[2][lane]});
  return block.packed.empty() ? 0.0F : kPackedOff + kPackedTurn * longest;
}

SolidBox box_of(const SolidLeaf& leaf, int lane, float more) {
  float R[9];
  axes_of(leaf, lane, R);
  const float longest = std::max({leaf.axes[0][lane], leaf.axes[1][lane], leaf.axes[2][lane]});
  SolidBox box;
  for (int k = 0; k < 3; ++k) {
    float squared = 0.0F;
    for (int j = 0; j < 3; ++j) {
      const float part = R[3 * k + j] * leaf.axes[j][lane];
      squared += part * part;
    }
    const float mean = leaf.mean[k][lane];
    const float half = std::sqrt(squared) * (1.0F + 2e-6F) + 1e-6F * longest + more;
    const float away = 2.4e-7F * std::abs(mean);
    box.low[k] = mean - half - away;
    box.high[k] = mean + half + away;
    box.reach[k] = half;
  }
  return box;
}

SolidBox hull(std::span<const SolidBox> boxes) {
  SolidBox all = nothing();
  for (const SolidBox& box : boxes) {
    for (int k = 0; k < 3; ++k) {
      all.low[k] = std::min(all.low[k], box.low[k]);
      all.high[k] = std::max(all.high[k], box.high[k]);
      all.reach[k] = std::max(all.reach[k], box.reach[k]);
    }
  }
  return all;
}

std::vector<SolidNode> make_tree(std::span<const SolidBox> boxes) {
  struct Level {
    std::vector<SolidNode> nodes;
    std::vector<SolidBox> boxes;
  };
  std::vector<Level> levels;
  std::span<const SolidBox> below = boxes;
  do {
    const std::size_t count = (below.size() + kFan - 1) / kFan;
    Level level{std::vector<SolidNode>(count), std::vector<SolidBox>(count)};
    for (std::size_t i = 0; i < count; ++i) {
      const auto children = below.subspan(i * kFan, std::min<std::size_t>(kFan, below.size() - i * kFan));
      for (int lane = 0; lane < kFan; ++lane) {
        const auto at = static_cast<std::size_t>(lane);
        const auto child = static_cast<std::int32_t>(i * kFan + at);
        const bool used = at < children.size();
        put_child(level.nodes[i], lane, used ? children[at] : nothing(), levels.empty() ? ~child : child);
      }
      level.boxes[i] = hull(children);
    }
    levels.push_back(std::move(level));
    below = levels.back().boxes;
  } while (below.size() > 1);
  std::vector<SolidNode> nodes;
  for (std::size_t l = levels.size(); l-- > 0;) {
    const auto next = static_cast<std::int32_t>(nodes.size() + levels[l].nodes.size());
    for (SolidNode& node : levels[l].nodes) {
      for (std::int32_t& child : node.child) {
        child = child >= 0 ? next + child : child;
      }
      nodes.push_back(node);
    }
  }
  return nodes;
}

std::shared_ptr<const SolidBlock> make_block(std::uint64_t key, std::span<const SolidPlace> order,
                                             const std::function<SolidItem(std::size_t)>& item_at, bool packed) {
  auto block = std::make_shared<SolidBlock>();
  block->key = key;
  block->count = order.size();
  std::vector<SolidBox> boxes((order.size() + kFan - 1) / kFan);
  if (packed && corner_of(key, item_at(order[0].index).mean, block->corner)) {
    block->packed.resize(boxes.size());
  } else {
    block->leaves.resize(boxes.size());
  }
  SolidLeaf room;
  for (std::size_t l = 0; l < boxes.size(); ++l) {
    std::array<SolidBox, kFan> own;
    const std::size_t used = std::min<std::size_t>(kFan, order.size() - l * kFan);
    SolidItem first;
    for (int lane = 0; lane < kFan; ++lane) {
      const bool real = static_cast<std::size_t>(lane) < used;
      const SolidItem item = real ? item_at(order[l * kFan + static_cast<std::size_t>(lane)].index) : first;
      first = lane == 0 ? item : first;
      if (block->packed.empty()) {
        put_lane(block->leaves[l], lane, item, real ? item.id : -1);
      } else {
        pack_lane(block->packed[l], lane, item, block->corner, real ? item.id : -1);
      }
    }
    const SolidLeaf& leaf = leaf_at(*block, l, room);
    for (int lane = 0; lane < static_cast<int>(used); ++lane) {
      own[static_cast<std::size_t>(lane)] = box_of(leaf, lane, packing_error(*block, leaf, lane));
    }
    boxes[l] = hull({own.data(), used});
  }
  block->nodes = make_tree(boxes);
  const SolidBox all = hull(boxes);
  std::copy(std::begin(all.low), std::end(all.low), block->low);
  std::copy(std::begin(all.high), std::end(all.high), block->high);
  std::copy(std::begin(all.reach), std::end(all.reach), block->reach);
  return block;
}

}  // namespace splatbot
