// SPDX-License-Identifier: Apache-2.0
#include "solid_blocks.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <utility>

#include "splatbot/threads.hpp"

namespace splatbot {

namespace {

constexpr int kBlockBits = 14;  // an axis: 2 km either way, beyond which blocks at the rim hold the rest
constexpr int kInBlockBits = kPlaceBits / 3;
constexpr std::uint64_t kLargeBlock = (std::uint64_t{1} << (3 * kBlockBits)) - 1;
constexpr float kSmallestAxis = 1e-9F;  // [m]; squares must not vanish
constexpr std::size_t kChunk = 4096;

// Bits of x three places apart.
std::uint64_t spread(std::uint64_t x) {
  x &= 0x1fffff;
  x = (x | x << 32) & 0x1f00000000ffff;
  x = (x | x << 16) & 0x1f0000ff0000ff;
  x = (x | x << 8) & 0x100f00f00f00f00f;
  x = (x | x << 4) & 0x10c30c30c30c30c3;
  return (x | x << 2) & 0x1249249249249249;
}

std::uint64_t key_of(const float* mean, float longest) {
  std::uint64_t block = 0, place = 0;
  for (int k = 0; k < 3; ++k) {
    const float at = mean[k] / kBlockEdge;
    const float cell = std::floor(at);
    constexpr float half = 1 << (kBlockBits - 1);
    block |= spread(static_cast<std::uint64_t>(std::clamp(cell, -half, half - 2.0F) + half)) << k;
    constexpr float parts = 1 << kInBlockBits;
    place |= spread(static_cast<std::uint64_t>(std::clamp((at - cell) * parts, 0.0F, parts - 1.0F))) << k;
  }
  return (longest > kBlockEdge ? kLargeBlock : block) << kPlaceBits | place;
}

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
    const float a = n_sigma * s.scales[3 * i + static_cast<std::size_t>(k)];
    item.axes[k] = std::max(a, kSmallestAxis) * (1.0F + 4.0F * std::numeric_limits<float>::epsilon());  // scales are rounded
    longest = std::max(longest, item.axes[k]);
  }
  item.key = key_of(item.mean, longest);
  item.id = s.ids[i];
  return item;
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

std::vector<SolidItem> make_items(const Solids& solids, float n_sigma) {
  std::vector<SolidItem> items(solids.ids.size());
  thread_pool()->run((items.size() + kChunk - 1) / kChunk, [&](std::size_t c) {
    for (std::size_t i = c * kChunk; i < std::min(items.size(), (c + 1) * kChunk); ++i) {
      items[i] = make_item(solids, i, n_sigma);
    }
  });
  return items;
}

void append_items(const SolidBlock& block, std::vector<SolidItem>& items) {
  for (const SolidLeaf& leaf : block.leaves) {
    for (int lane = 0; lane < kFan; ++lane) {
      if (leaf.id[lane] < 0) {
        continue;
      }
      SolidItem item;
      float longest = 0.0F;
      for (int k = 0; k < 3; ++k) {
        item.mean[k] = leaf.mean[k][lane];
        item.axes[k] = leaf.axes[k][lane];
        longest = std::max(longest, item.axes[k]);
      }
      for (int k = 0; k < 4; ++k) {
        item.quat[k] = leaf.quat[k][lane];
      }
      item.id = leaf.id[lane];
      item.key = key_of(item.mean, longest);
      items.push_back(item);
    }
  }
}

void sort_items(std::vector<SolidItem>& items) {
  struct Entry {
    std::uint64_t key;
    std::uint32_t id, index;
  };
  std::vector<Entry> from(items.size()), to(items.size());
  bool by_id = true;
  std::uint64_t any = 0, all = ~std::uint64_t{0};
  for (std::size_t i = 0; i < items.size(); ++i) {
    from[i] = {items[i].key, static_cast<std::uint32_t>(items[i].id), static_cast<std::uint32_t>(i)};
    by_id &= i == 0 || from[i - 1].id < from[i].id;
    any |= items[i].key;
    all &= items[i].key;
  }
  if (!by_id || items.size() < 2048) {
    std::sort(from.begin(), from.end(),
              [](const Entry& a, const Entry& b) { return a.key < b.key || (a.key == b.key && a.id < b.id); });
  } else {
    for (int shift = 0; shift < 64; shift += 11) {  // stable, so that ids stay in order
      if ((((any ^ all) >> shift) & 0x7ff) == 0) {
        continue;
      }
      std::array<std::uint32_t, 2048> count{};
      for (const Entry& e : from) {
        ++count[(e.key >> shift) & 0x7ff];
      }
      std::uint32_t sum = 0;
      for (std::uint32_t& c : count) {
        sum += std::exchange(c, sum);
      }
      for (const Entry& e : from) {
        to[count[(e.key >> shift) & 0x7ff]++] = e;
      }
      from.swap(to);
    }
  }
  std::vector<SolidItem> sorted(items.size());
  for (std::size_t i = 0; i < items.size(); ++i) {
    sorted[i] = items[from[i].index];
  }
  items.swap(sorted);
}

void axes_of(const SolidLeaf& leaf, int lane, float R[9]) {
  const float w = leaf.quat[0][lane], x = leaf.quat[1][lane], y = leaf.quat[2][lane], z = leaf.quat[3][lane];
  const float rows[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                         2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
  std::copy(std::begin(rows), std::end(rows), R);
}

SolidBox box_of(const SolidLeaf& leaf, int lane) {
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
    const float half = std::sqrt(squared) * (1.0F + 2e-6F) + 1e-6F * longest;
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

std::shared_ptr<const SolidBlock> make_block(std::span<const SolidItem> items) {
  auto block = std::make_shared<SolidBlock>();
  block->key = block_key(items.front().key);
  block->count = items.size();
  block->leaves.resize((items.size() + kFan - 1) / kFan);
  std::vector<SolidBox> boxes(block->leaves.size());
  for (std::size_t l = 0; l < boxes.size(); ++l) {
    std::array<SolidBox, kFan> own;
    const std::size_t used = std::min<std::size_t>(kFan, items.size() - l * kFan);
    for (int lane = 0; lane < kFan; ++lane) {
      const bool real = static_cast<std::size_t>(lane) < used;
      const SolidItem& item = items[l * kFan + (real ? static_cast<std::size_t>(lane) : 0)];
      put_lane(block->leaves[l], lane, item, real ? item.id : -1);
      own[static_cast<std::size_t>(lane)] = box_of(block->leaves[l], lane);
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
