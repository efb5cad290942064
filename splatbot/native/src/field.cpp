// SPDX-License-Identifier: Apache-2.0
#include "splatbot/field.hpp"

#include <algorithm>
#include <array>
#include <numeric>
#include <unordered_map>

#include "solid_blocks.hpp"
#include "solid_covers.hpp"
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

// The order of points (P, 3) along a Morton curve through their box: neighbours in it are neighbours in space.
std::vector<std::uint32_t> along_a_curve(std::span<const double> points) {
  constexpr double kCells = 1024.0;
  double low[3] = {1e300, 1e300, 1e300}, high[3] = {-1e300, -1e300, -1e300};
  for (std::size_t i = 0; i < points.size(); ++i) {
    low[i % 3] = std::min(low[i % 3], points[i]);
    high[i % 3] = std::max(high[i % 3], points[i]);
  }
  std::vector<std::uint64_t> keys(points.size() / 3);
  std::vector<std::uint32_t> order(keys.size());
  for (std::size_t i = 0; i < keys.size(); ++i) {
    for (std::size_t k = 0; k < 3; ++k) {
      const double share = (points[3 * i + k] - low[k]) / std::max(high[k] - low[k], 1e-300);
      keys[i] |= spread_bits(static_cast<std::uint64_t>(std::min(share * kCells, kCells - 1.0))) << k;
    }
  }
  std::iota(order.begin(), order.end(), 0U);
  std::sort(order.begin(), order.end(), [&](std::uint32_t a, std::uint32_t b) { return keys[a] < keys[b]; });
  return order;
}

SolidBox box_of(const SolidBlock& block) {
  SolidBox box;
  std::copy(std::begin(block.low), std::end(block.low), box.low);
  std::copy(std::begin(block.high), std::end(block.high), box.high);
  std::copy(std::begin(block.reach), std::end(block.reach), box.reach);
  return box;
}

std::size_t own_bytes(const SolidBlock& block) {
  return block.leaves.size() * sizeof(SolidLeaf) + block.packed.size() * sizeof(PackedLeaf) +
         block.nodes.size() * sizeof(SolidNode);
}

}  // namespace

CollisionField::CollisionField(const Solids& solids, const FieldOptions& options) : options_(options) {
  const float n_sigma = options.n_sigma;
  std::vector<SolidPlace> order;
  const auto runs = sort_into_blocks(
      solids.ids.size(), [&](std::size_t i) { return key_of(solids, i, n_sigma); },
      [&](std::size_t i) { return solids.ids[i]; }, order);
  blocks_.resize(runs.size());
  thread_pool()->run(runs.size(), [&](std::size_t b) {
    blocks_[b] = make_block(runs[b].key, std::span(order).subspan(runs[b].begin, runs[b].end - runs[b].begin),
                            [&](std::size_t i) { return make_item(solids, i, n_sigma); }, options_.packed);
  });
  if (!options_.packed) {
    block_of_ = blocks_by_id();
  }
  size_ = solids.ids.size();
  grid_ = make_grid(blocks_, options_);
  finish();
}

std::vector<std::int32_t> CollisionField::blocks_by_id() const {
  std::vector<std::int32_t> found;
  const auto note = [&](const std::int32_t* ids, std::size_t b) {
    for (int lane = 0; lane < kFan && ids[lane] >= 0; ++lane) {
      const auto id = static_cast<std::size_t>(ids[lane]);
      if (id >= found.size()) {
        found.resize(std::max(id + 1, found.size() + found.size() / 2), -1);
      }
      found[id] = static_cast<std::int32_t>(b);
    }
  };
  for (std::size_t b = 0; b < blocks_.size(); ++b) {
    if (blocks_[b]) {
      std::for_each(blocks_[b]->leaves.begin(), blocks_[b]->leaves.end(), [&](const auto& leaf) { note(leaf.id, b); });
      std::for_each(blocks_[b]->packed.begin(), blocks_[b]->packed.end(), [&](const auto& leaf) { note(leaf.id, b); });
    }
  }
  while (!found.empty() && found.back() < 0) {
    found.pop_back();
  }
  found.shrink_to_fit();
  return found;
}

std::shared_ptr<const CollisionField> CollisionField::added_since(const CollisionField& earlier) const {
  using Content = std::array<float, 10>;
  const auto content = [](const SolidItem& item) {
    Content c;
    std::copy_n(item.mean, 3, c.begin());
    std::copy_n(item.quat, 4, c.begin() + 3);
    std::copy_n(item.axes, 3, c.begin() + 7);
    return c;
  };
  std::unordered_map<std::uint64_t, const SolidBlock*> theirs;
  for (const auto& block : earlier.blocks_) {
    if (block) {
      theirs.emplace(block->key, block.get());
    }
  }
  std::vector<SolidItem> added, mine, before;
  for (const auto& block : blocks_) {
    if (!block) {
      continue;
    }
    const auto found = theirs.find(block->key);
    if (found != theirs.end() && found->second == block.get()) {
      continue;
    }
    std::vector<Content> known;
    before.clear();
    if (found != theirs.end()) {
      append_items(*found->second, before);
    }
    for (const SolidItem& item : before) {
      known.push_back(content(item));
    }
    std::sort(known.begin(), known.end());
    mine.clear();
    append_items(*block, mine);
    for (const SolidItem& item : mine) {
      if (!std::binary_search(known.begin(), known.end(), content(item))) {
        added.push_back(item);
      }
    }
  }
  const std::shared_ptr<CollisionField> field(new CollisionField());
  field->options_ = options_;
  field->options_.voxel = 0.0F;
  std::vector<SolidPlace> order;
  const auto runs = sort_into_blocks(
      added.size(), [&](std::size_t i) { return added[i].key; }, [&](std::size_t i) { return added[i].id; }, order);
  for (const BlockRun& run : runs) {
    field->blocks_.push_back(make_block(run.key, std::span(order).subspan(run.begin, run.end - run.begin),
                                        [&](std::size_t i) { return added[i]; }, options_.packed));
  }
  field->size_ = added.size();
  field->finish();
  return field;
}

void CollisionField::finish() {
  std::vector<std::pair<std::uint64_t, std::int32_t>> order;
  views_.assign(blocks_.size(), {});
  for (std::size_t b = 0; b < blocks_.size(); ++b) {
    if (blocks_[b]) {
      const SolidBlock& block = *blocks_[b];
      views_[b] = {block.nodes.data(), block.leaves.data(), block.packed.empty() ? nullptr : block.packed.data(),
                   {block.corner[0], block.corner[1], block.corner[2]}};
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
  next->block_of_ = options_.packed ? blocks_by_id() : block_of_;
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
  SolidLeaf room;
  for (std::size_t b = 0; b < blocks_.size(); ++b) {
    if (stale[b] == 0) {
      continue;
    }
    const SolidBlock& block = *blocks_[b];
    std::vector<SolidItem> kept;
    append_items(block, kept);
    for (std::size_t l = 0; l < leaf_count(block); ++l) {  // only removals change the grid
      const SolidLeaf& leaf = leaf_at(block, l, room);
      for (int lane = 0; lane < kFan && leaf.id[lane] >= 0; ++lane) {
        if (next->block_of_[static_cast<std::size_t>(leaf.id[lane])] != static_cast<std::int32_t>(b)) {
          widen(box, box_of(leaf, lane, packing_error(block, leaf, lane)));
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
  std::vector<SolidPlace> order;
  const auto runs = sort_into_blocks(
      items.size(), [&](std::size_t i) { return items[i].key; }, [&](std::size_t i) { return items[i].id; }, order);
  std::vector<std::int32_t> places(runs.size());
  for (std::size_t r = 0; r < runs.size(); ++r) {
    const auto [slot, added] = slots.emplace(runs[r].key, static_cast<std::int32_t>(next->blocks_.size()));
    if (added) {
      next->blocks_.emplace_back();
    }
    places[r] = slot->second;
  }
  thread_pool()->run(runs.size(), [&](std::size_t r) {
    next->blocks_[static_cast<std::size_t>(places[r])] =
        make_block(runs[r].key, std::span(order).subspan(runs[r].begin, runs[r].end - runs[r].begin),
                   [&](std::size_t i) { return items[i]; }, options_.packed);
  });
  for (std::size_t r = 0; r < runs.size(); ++r) {
    for (std::size_t i = runs[r].begin; i < runs[r].end; ++i) {
      next->block_of_[static_cast<std::size_t>(items[order[i].index].id)] = places[r];
    }
    const SolidBlock& block = *next->blocks_[static_cast<std::size_t>(places[r])];
    for (std::size_t l = 0; l < leaf_count(block); ++l) {
      const SolidLeaf& leaf = leaf_at(block, l, room);
      for (int lane = 0; lane < kFan && leaf.id[lane] >= 0; ++lane) {
        if (fresh[static_cast<std::size_t>(leaf.id[lane])] != 0) {
          widen(box, box_of(leaf, lane, packing_error(block, leaf, lane)));
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
  if (options_.packed) {
    std::vector<std::int32_t>().swap(next->block_of_);
  }
  next->finish();
  return next;
}

std::size_t CollisionField::bytes() const {
  std::size_t sum = block_of_.size() * sizeof(std::int32_t) + top_.size() * sizeof(SolidNode) +
                    views_.size() * sizeof(SolidBlockView);
  for (const auto& block : blocks_) {
    sum += block ? sizeof(SolidBlock) + own_bytes(*block) + block->covers.bytes.load() : 0;
  }
  return sum + top_covers_.bytes.load() + (grid_ ? grid_->marks.size() + grid_->bound.size() : 0);
}

std::size_t CollisionField::shared_bytes(const CollisionField& other) const {
  std::size_t sum = 0;
  for (std::size_t b = 0; b < std::min(blocks_.size(), other.blocks_.size()); ++b) {
    if (blocks_[b] && blocks_[b] == other.blocks_[b]) {
      sum += own_bytes(*blocks_[b]);
    }
  }
  return sum;
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

SolidCoversView CollisionField::covers() const {
  std::call_once(top_covers_.once, [this] {
    block_covers_.assign(blocks_.size(), nullptr);
    thread_pool()->run(blocks_.size(), [this](std::size_t b) {
      if (blocks_[b]) {
        block_covers_[b] = covers_of(*blocks_[b]).nodes.data();
      }
    });
    cover_top(top_, blocks_, top_covers_);
  });
  return {top_covers_.nodes.data(), block_covers_.data()};
}

void CollisionField::mahalanobis(std::span<const double> points, std::span<double> distance,
                                 std::span<std::int32_t> id) const {
  const FieldKernels& k = *kernels().field;
  const SolidCoversView covering = covers();
  const std::vector<std::uint32_t> order = along_a_curve(points);
  in_parts(id.size(), [&](std::size_t begin, std::size_t end) {
    k.mahalanobis(view_, covering, points.data(), order.data(), begin, end, distance.data(), id.data());
  });
}

void CollisionField::grid_bounds(std::span<const double> points, std::span<float> out) const {
  const FieldKernels& k = *kernels().field;
  in_parts(out.size(), [&](std::size_t begin, std::size_t end) {
    k.grid_bounds(view_, points.data(), begin, end, out.data());
  });
}

}  // namespace splatbot
