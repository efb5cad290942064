// SPDX-License-Identifier: Apache-2.0
#include "splatbot/field.hpp"

#include <algorithm>
#include <unordered_map>

#include "solid_blocks.hpp"
#include "solid_grid.hpp"
#include "splatbot/kernels.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {

namespace {

constexpr std::size_t kFewest = 64;  // queries to a task

// Calls ask(begin, end) for parts of [0, count), on all threads.
template <class Ask>
void in_parts(std::size_t count, Ask&& ask) {
  const auto pool = thread_pool();
  const std::size_t part = std::max(kFewest, count / (8 * pool->size()) + 1);
  pool->run((count + part - 1) / part, [&](std::size_t i) { ask(i * part, std::min(count, (i + 1) * part)); });
}

// Runs of one block in sorted items.
std::vector<std::span<const SolidItem>> runs_of(std::span<const SolidItem> items) {
  std::vector<std::span<const SolidItem>> runs;
  for (std::size_t begin = 0, end = 0; begin < items.size(); begin = end) {
    for (end = begin + 1; end < items.size() && block_key(items[end].key) == block_key(items[begin].key); ++end) {
    }
    runs.push_back(items.subspan(begin, end - begin));
  }
  return runs;
}

void widen(float box[6], const SolidBox& other) {
  for (int k = 0; k < 3; ++k) {
    box[k] = std::min(box[k], other.low[k]);
    box[3 + k] = std::max(box[3 + k], other.high[k]);
  }
}

void clear_box(float box[6]) {
  std::fill(box, box + 3, 1e30F);
  std::fill(box + 3, box + 6, -1e30F);
}

SolidBox box_of(const SolidBlock& block) {
  SolidBox box;
  std::copy(std::begin(block.low), std::end(block.low), box.low);
  std::copy(std::begin(block.high), std::end(block.high), box.high);
  std::copy(std::begin(block.reach), std::end(block.reach), box.reach);
  return box;
}

}  // namespace

CollisionField::CollisionField(const Solids& solids, const FieldOptions& options) : options_(options) {
  std::vector<SolidItem> items = make_items(solids, options.n_sigma);
  sort_items(items);
  const auto runs = runs_of(items);
  blocks_.resize(runs.size());
  thread_pool()->run(runs.size(), [&](std::size_t b) { blocks_[b] = make_block(runs[b]); });
  std::int32_t most = -1;
  for (const SolidItem& item : items) {
    most = std::max(most, item.id);
  }
  block_of_.assign(static_cast<std::size_t>(most + 1), -1);
  for (std::size_t b = 0; b < runs.size(); ++b) {
    for (const SolidItem& item : runs[b]) {
      block_of_[static_cast<std::size_t>(item.id)] = static_cast<std::int32_t>(b);
    }
  }
  size_ = items.size();
  grid_ = make_grid(blocks_, options_);
  finish();
}

void CollisionField::finish() {
  std::vector<std::pair<std::uint64_t, std::int32_t>> order;
  views_.assign(blocks_.size(), {});
  for (std::size_t b = 0; b < blocks_.size(); ++b) {
    if (blocks_[b]) {
      views_[b] = {blocks_[b]->nodes.data(), blocks_[b]->leaves.data()};
      order.emplace_back(blocks_[b]->key, static_cast<std::int32_t>(b));
    }
  }
  std::sort(order.begin(), order.end());
  std::vector<SolidBox> boxes;
  for (const auto& [key, b] : order) {
    boxes.push_back(box_of(*blocks_[static_cast<std::size_t>(b)]));
  }
  top_.clear();
  if (!boxes.empty()) {
    top_ = make_tree(boxes);
    for (SolidNode& node : top_) {
      for (std::int32_t& child : node.child) {
        const auto at = static_cast<std::size_t>(~child);
        child = child < 0 && at < order.size() ? ~order[at].second : child;
      }
    }
  }
  view_ = {.top = top_.empty() ? nullptr : top_.data(), .blocks = views_.data(), .grid = {}, .n_sigma = options_.n_sigma};
  if (grid_) {
    view_.grid = {grid_->bound.data(), {grid_->size[0], grid_->size[1], grid_->size[2]},
                  {grid_->origin[0], grid_->origin[1], grid_->origin[2]}, grid_->voxel, 1.0F / grid_->voxel};
  }
}

std::shared_ptr<const CollisionField> CollisionField::updated(std::span<const std::int32_t> removed,
                                                              const Solids& inserted) const {
  const std::shared_ptr<CollisionField> next(new CollisionField());
  next->options_ = options_;
  next->blocks_ = blocks_;
  next->block_of_ = block_of_;
  std::vector<SolidItem> items = make_items(inserted, options_.n_sigma);
  std::unordered_map<std::uint64_t, std::int32_t> slots;
  for (std::size_t b = 0; b < blocks_.size(); ++b) {
    if (blocks_[b]) {
      slots.emplace(blocks_[b]->key, static_cast<std::int32_t>(b));
    }
  }
  std::vector<std::uint8_t> stale(blocks_.size(), 0);
  const auto drop = [&](std::int32_t id) {
    const auto at = static_cast<std::size_t>(id);
    if (id >= 0 && at < next->block_of_.size() && next->block_of_[at] >= 0) {
      stale[static_cast<std::size_t>(next->block_of_[at])] = 1;
      next->block_of_[at] = -1;
    }
  };
  std::for_each(removed.begin(), removed.end(), drop);
  for (const SolidItem& item : items) {
    drop(item.id);
  }
  for (const SolidItem& item : items) {
    if (const auto slot = slots.find(block_key(item.key)); slot != slots.end()) {
      stale[static_cast<std::size_t>(slot->second)] = 1;
    }
  }
  float box[6];
  clear_box(box);
  for (std::size_t b = 0; b < blocks_.size(); ++b) {
    if (stale[b] == 0) {
      continue;
    }
    const SolidBlock& block = *blocks_[b];
    std::vector<SolidItem> kept;
    append_items(block, kept);
    for (const SolidLeaf& leaf : block.leaves) {  // only what goes changes the grid
      for (int lane = 0; lane < kFan && leaf.id[lane] >= 0; ++lane) {
        if (next->block_of_[static_cast<std::size_t>(leaf.id[lane])] != static_cast<std::int32_t>(b)) {
          widen(box, box_of(leaf, lane));
        }
      }
    }
    for (const SolidItem& item : kept) {
      if (next->block_of_[static_cast<std::size_t>(item.id)] == static_cast<std::int32_t>(b)) {
        items.push_back(item);
      }
    }
    next->blocks_[b] = nullptr;
  }
  std::int32_t most = -1;
  for (const SolidItem& item : items) {
    most = std::max(most, item.id);
  }
  if (static_cast<std::size_t>(most + 1) > next->block_of_.size()) {
    next->block_of_.resize(static_cast<std::size_t>(most + 1), -1);
  }
  std::vector<std::uint8_t> fresh(next->block_of_.size(), 0);
  for (const std::int32_t id : inserted.ids) {
    fresh[static_cast<std::size_t>(id)] = 1;
  }
  sort_items(items);
  const auto runs = runs_of(items);
  std::vector<std::int32_t> places(runs.size());
  for (std::size_t r = 0; r < runs.size(); ++r) {
    const auto [slot, added] = slots.emplace(block_key(runs[r].front().key), static_cast<std::int32_t>(next->blocks_.size()));
    if (added) {
      next->blocks_.emplace_back();
    }
    places[r] = slot->second;
  }
  thread_pool()->run(runs.size(), [&](std::size_t r) {
    next->blocks_[static_cast<std::size_t>(places[r])] = make_block(runs[r]);
  });
  for (std::size_t r = 0; r < runs.size(); ++r) {
    for (const SolidItem& item : runs[r]) {
      next->block_of_[static_cast<std::size_t>(item.id)] = places[r];
    }
    const SolidBlock& block = *next->blocks_[static_cast<std::size_t>(places[r])];
    for (const SolidLeaf& leaf : block.leaves) {
      for (int lane = 0; lane < kFan && leaf.id[lane] >= 0; ++lane) {
        if (fresh[static_cast<std::size_t>(leaf.id[lane])] != 0) {
          widen(box, box_of(leaf, lane));
        }
      }
    }
  }
  for (const auto& block : next->blocks_) {
    next->size_ += block ? block->count : 0;
  }
  if (!grid_ || outgrown(*grid_, next->blocks_)) {
    next->grid_ = make_grid(next->blocks_, options_);
  } else if (box[0] <= box[3]) {
    auto grid = std::make_shared<BoundGrid>(*grid_);
    refresh(*grid, next->blocks_, box);
    next->grid_ = std::move(grid);
  } else {
    next->grid_ = grid_;
  }
  next->finish();
  return next;
}

std::size_t CollisionField::bytes() const {
  std::size_t sum = block_of_.size() * sizeof(std::int32_t) + top_.size() * sizeof(SolidNode) +
                    views_.size() * sizeof(SolidBlockView);
  for (const auto& block : blocks_) {
    sum += block ? sizeof(SolidBlock) + block->leaves.size() * sizeof(SolidLeaf) + block->nodes.size() * sizeof(SolidNode)
                 : 0;
  }
  return sum + (grid_ ? grid_->marks.size() + grid_->bound.size() : 0);
}

std::size_t CollisionField::shared_bytes(const CollisionField& other) const {
  std::size_t sum = 0;
  for (std::size_t b = 0; b < std::min(blocks_.size(), other.blocks_.size()); ++b) {
    if (blocks_[b] && blocks_[b] == other.blocks_[b]) {
      sum += blocks_[b]->leaves.size() * sizeof(SolidLeaf) + blocks_[b]->nodes.size() * sizeof(SolidNode);
    }
  }
  return sum;
}

bool CollisionField::changed_box(const CollisionField& other, float box[6]) const {
  clear_box(box);
  std::unordered_map<std::uint64_t, const SolidBlock*> theirs;
  for (const auto& block : other.blocks_) {
    if (block) {
      theirs.emplace(block->key, block.get());
    }
  }
  for (const auto& block : blocks_) {
    if (!block) {
      continue;
    }
    const auto found = theirs.find(block->key);
    if (found != theirs.end() && found->second == block.get()) {
      theirs.erase(found);
    } else {
      widen(box, box_of(*block));
    }
  }
  for (const auto& [key, block] : theirs) {
    widen(box, box_of(*block));
  }
  return box[0] <= box[3];
}

void CollisionField::hits(const SphereQueries& queries, std::size_t count, std::span<std::uint8_t> out) const {
  const FieldKernels& k = *kernels().field;
  in_parts(count, [&](std::size_t begin, std::size_t end) { k.hits(view_, queries, begin, end, out.data()); });
}

void CollisionField::nearest(const SphereQueries& queries, std::size_t count, float cut,
                             std::span<NearestSolid> out) const {
  const FieldKernels& k = *kernels().field;
  in_parts(count, [&](std::size_t begin, std::size_t end) { k.nearest(view_, queries, cut, begin, end, out.data()); });
}

void CollisionField::k_nearest(const SphereQueries& queries, std::size_t count, int neighbours, float cut,
                               std::span<double> distance, std::span<std::int32_t> id) const {
  const FieldKernels& k = *kernels().field;
  in_parts(count, [&](std::size_t begin, std::size_t end) {
    k.k_nearest(view_, queries, neighbours, cut, begin, end, distance.data(), id.data());
  });
}

void CollisionField::mahalanobis(std::span<const double> points, std::span<double> distance,
                                 std::span<std::int32_t> id) const {
  const FieldKernels& k = *kernels().field;
  in_parts(id.size(), [&](std::size_t begin, std::size_t end) {
    k.mahalanobis(view_, points.data(), begin, end, distance.data(), id.data());
  });
}

void CollisionField::grid_bounds(std::span<const double> points, std::span<float> out) const {
  const FieldKernels& k = *kernels().field;
  in_parts(out.size(), [&](std::size_t begin, std::size_t end) {
    k.grid_bounds(view_, points.data(), begin, end, out.data());
  });
}

}  // namespace splatbot
