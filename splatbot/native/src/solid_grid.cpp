// SPDX-License-Identifier: Apache-2.0
#include "solid_grid.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "solid_blocks.hpp"
#include "splatbot/buffer.hpp"
#include "splatbot/kernels.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {

namespace {

constexpr float kMargin = 0.3F;        // [m] around the mapped region: the range of a bound
constexpr double kOutside = 0.004;     // share of the Gaussians at either end of an axis that the grid need not hold
constexpr double kMostOutside = 0.05;  // beyond it the grid is rebuilt

struct Range {
  std::int32_t low[3], high[3];  // voxels [low, high)

  bool empty() const { return low[0] >= high[0] || low[1] >= high[1] || low[2] >= high[2]; }
  std::size_t count() const {
    std::size_t n = 1;
    for (int k = 0; k < 3; ++k) {
      n *= static_cast<std::size_t>(high[k] - low[k]);
    }
    return n;
  }
};

Range whole(const BoundGrid& g) { return {{0, 0, 0}, {g.size[0], g.size[1], g.size[2]}}; }

// The voxels that a box may touch.
Range voxels_of(const BoundGrid& g, const float* low, const float* high) {
  Range r;
  for (int k = 0; k < 3; ++k) {
    const float away = 1e-6F * (std::abs(low[k]) + std::abs(high[k]) + std::abs(g.origin[k]));
    const float first = std::floor((low[k] - away - g.origin[k]) / g.voxel);
    const float last = std::floor((high[k] + away - g.origin[k]) / g.voxel);
    const auto size = static_cast<float>(g.size[k]);
    r.low[k] = static_cast<std::int32_t>(std::clamp(first, 0.0F, size));
    r.high[k] = static_cast<std::int32_t>(std::clamp(last + 1.0F, 0.0F, size));
  }
  return r;
}

Range intersection(const Range& a, const Range& b) {
  Range r;
  for (int k = 0; k < 3; ++k) {
    r.low[k] = std::max(a.low[k], b.low[k]);
    r.high[k] = std::min(a.high[k], b.high[k]);
  }
  return r;
}

std::uint8_t& mark_of(BoundGrid& g, std::int32_t x, std::int32_t y, std::int32_t z) {
  return g.marks[(static_cast<std::size_t>(z) * static_cast<std::size_t>(g.size[1]) + static_cast<std::size_t>(y)) *
                     static_cast<std::size_t>(g.size[0]) +
                 static_cast<std::size_t>(x)];
}

// True if all of a few voxels are marked already, as is common for ellipsoids smaller than voxels.
bool all_marked(BoundGrid& grid, const Range& r) {
  if (r.count() > 8) {
    return false;
  }
  for (std::int32_t z = r.low[2]; z < r.high[2]; ++z) {
    for (std::int32_t y = r.low[1]; y < r.high[1]; ++y) {
      for (std::int32_t x = r.low[0]; x < r.high[0]; ++x) {
        if (std::atomic_ref(mark_of(grid, x, y, z)).load(std::memory_order_relaxed) == 0) {
          return false;
        }
      }
    }
  }
  return true;
}

// Marks the voxels that an ellipsoid may touch: those not parted from it by a plane across one of its axes.
class Marker {
 public:
  Marker(BoundGrid& grid, const SolidLeaf& leaf, int lane, float more) : grid_(grid) {
    float R[9];
    axes_of(leaf, lane, R);
    for (int j = 0; j < 3; ++j) {
      for (int k = 0; k < 3; ++k) {
        across_[j][k] = R[3 * k + j];
        size_[j][k] = std::abs(R[3 * k + j]) * 0.5F * grid.voxel;
      }
      axes_[j] = leaf.axes[j][lane];
    }
    float most = 0.0F;
    for (int k = 0; k < 3; ++k) {
      mean_[k] = leaf.mean[k][lane] - grid.origin[k];
      most = std::max({most, std::abs(leaf.mean[k][lane]), std::abs(grid.origin[k])});
    }
    slack_ = more + 1e-6F * (most + static_cast<float>(std::max({grid.size[0], grid.size[1], grid.size[2]})) * grid.voxel);
  }

  void mark(const Range& r) {
    if (r.count() > kFew && parted(r)) {
      return;
    }
    if (r.count() > kFew) {
      int longest = 0;
      for (int k = 1; k < 3; ++k) {
        longest = r.high[k] - r.low[k] > r.high[longest] - r.low[longest] ? k : longest;
      }
      Range near = r, far = r;
      near.high[longest] = far.low[longest] = (r.low[longest] + r.high[longest]) / 2;
      mark(near);
      mark(far);
      return;
    }
    for (std::int32_t z = r.low[2]; z < r.high[2]; ++z) {
      for (std::int32_t y = r.low[1]; y < r.high[1]; ++y) {
        for (std::int32_t x = r.low[0]; x < r.high[0]; ++x) {
          const std::atomic_ref mark(mark_of(grid_, x, y, z));  // blocks may mark the same voxel at once
          if (mark.load(std::memory_order_relaxed) == 0 && !parted({{x, y, z}, {x + 1, y + 1, z + 1}})) {
            mark.store(1, std::memory_order_relaxed);
          }
        }
      }
    }
  }

 private:
  static constexpr std::size_t kFew = 27;

  bool parted(const Range& r) const {
    float from[3];
    for (int k = 0; k < 3; ++k) {
      from[k] = 0.5F * static_cast<float>(r.low[k] + r.high[k]) * grid_.voxel - mean_[k];
    }
    for (int j = 0; j < 3; ++j) {
      float off = 0.0F, half = axes_[j] + slack_;
      for (int k = 0; k < 3; ++k) {
        off += across_[j][k] * from[k];
        half += size_[j][k] * static_cast<float>(r.high[k] - r.low[k]);
      }
      if (std::abs(off) > half) {
        return true;
      }
    }
    return false;
  }

  BoundGrid& grid_;
  float across_[3][3], size_[3][3], axes_[3], mean_[3], slack_;
};

void mark_block(BoundGrid& grid, const SolidBlock& block, const Range& range) {
  if (intersection(voxels_of(grid, block.low, block.high), range).empty()) {
    return;
  }
  SolidLeaf room;
  for (std::size_t l = 0; l < leaf_count(block); ++l) {
    const SolidLeaf& leaf = leaf_at(block, l, room);
    for (int lane = 0; lane < kFan && leaf.id[lane] >= 0; ++lane) {
      const float more = packing_error(block, leaf, lane);
      const SolidBox box = box_of(leaf, lane, more);
      const Range touched = intersection(voxels_of(grid, box.low, box.high), range);
      if (!touched.empty() && !all_marked(grid, touched)) {
        Marker(grid, leaf, lane, more).mark(touched);
      }
    }
  }
}

void clear_marks(BoundGrid& grid, const Range& r) {
  for (std::int32_t z = r.low[2]; z < r.high[2]; ++z) {
    for (std::int32_t y = r.low[1]; y < r.high[1]; ++y) {
      std::uint8_t* row = grid.marks.data() + (static_cast<std::size_t>(z) * static_cast<std::size_t>(grid.size[1]) +
                                               static_cast<std::size_t>(y)) * static_cast<std::size_t>(grid.size[0]);
      std::memset(row + r.low[0], 0, static_cast<std::size_t>(r.high[0] - r.low[0]));
    }
  }
}

void fill_bounds(BoundGrid& grid, const Range& marked) {
  BoundArgs args{};
  Range around;
  for (int k = 0; k < 3; ++k) {
    args.size[k] = grid.size[k];
    args.low[k] = std::max(marked.low[k] - kBoundReach, 0);
    args.high[k] = std::min(marked.high[k] + kBoundReach, grid.size[k]);
    around.low[k] = std::max(args.low[k] - kBoundReach, 0);
    around.high[k] = std::min(args.high[k] + kBoundReach, grid.size[k]);
  }
  args.open = grid.open;
  args.marks = grid.marks.data();
  args.bound = grid.bound.data();
  args.x0 = around.low[0];
  args.x1 = around.high[0];
  args.y0 = around.low[1];
  args.y1 = around.high[1];
  const auto width = static_cast<std::size_t>(args.x1 - args.x0), lines = static_cast<std::size_t>(args.y1 - args.y0);
  std::vector<std::uint8_t> along_z(width * lines * static_cast<std::size_t>(args.high[2] - args.low[2]));
  args.along_z = along_z.data();
  const FieldKernels& k = *kernels().field;
  const auto pool = thread_pool();
  pool->run(lines, [&](std::size_t i) {
    static thread_local Buffer<std::uint8_t> steps;
    steps.resize(width + 64);
    k.bound_columns(args, args.y0 + static_cast<int>(i), steps.data());
  });
  pool->run(static_cast<std::size_t>(args.high[2] - args.low[2]), [&](std::size_t i) {
    static thread_local Buffer<std::uint16_t> line;
    line.resize(2 * width + 4 * kBoundReach + 64);
    k.bound_slice(args, args.low[2] + static_cast<int>(i), line.data());
  });
}

void mark(BoundGrid& grid, BlockList blocks, const Range& range) {
  thread_pool()->run(blocks.size(), [&](std::size_t b) {
    if (blocks[b]) {
      mark_block(grid, *blocks[b], range);
    }
  });
}

bool reaches_out(const BoundGrid& grid, BlockList blocks) {
  for (const auto& block : blocks) {
    for (int k = 0; block && k < 3; ++k) {
      if (block->low[k] < grid.origin[k] ||
          block->high[k] > grid.origin[k] + static_cast<float>(grid.size[k]) * grid.voxel) {
        return true;
      }
    }
  }
  return false;
}

// Bounds of the Gaussians' means without a share at either end of each axis, with a margin; false for an empty field.
bool extent(BlockList blocks, double aside, float* low, float* high) {
  std::vector<float> along[3];
  SolidLeaf room;
  for (const auto& block : blocks) {
    for (std::size_t l = 0; block && l < leaf_count(*block); ++l) {
      const SolidLeaf& leaf = leaf_at(*block, l, room);
      for (int k = 0; k < 3; ++k) {
        const float* means = leaf.mean[k];
        const auto [least, most] = std::minmax_element(means, means + kFan);
        along[k].insert(along[k].end(), {*least, *most});
      }
    }
  }
  for (int k = 0; k < 3 && !along[0].empty(); ++k) {
    auto& values = along[k];
    const auto skip = static_cast<std::ptrdiff_t>(aside * static_cast<double>(values.size()));
    std::nth_element(values.begin(), values.begin() + skip, values.end());
    low[k] = values[static_cast<std::size_t>(skip)] - kMargin;
    std::nth_element(values.begin(), values.end() - 1 - skip, values.end());
    high[k] = *(values.end() - 1 - skip) + kMargin;
  }
  return !along[0].empty();
}

bool fit(BoundGrid& grid, const float* low, const float* high, std::size_t most) {
  double voxels = 1.0;
  for (int k = 0; k < 3; ++k) {
    const double cells = std::ceil(static_cast<double>(high[k] - low[k]) / static_cast<double>(grid.voxel));
    grid.size[k] = static_cast<std::int32_t>(std::min(cells, 1e6));
    voxels *= cells;
  }
  return voxels <= static_cast<double>(most);
}

}  // namespace

std::shared_ptr<BoundGrid> make_grid(BlockList blocks, const FieldOptions& options) {
  auto grid = std::make_shared<BoundGrid>();
  float low[3], high[3];
  grid->voxel = options.voxel;
  if (!(options.voxel > 0.0F) || !extent(blocks, 0.0, low, high)) {
    return nullptr;
  }
  if (!fit(*grid, low, high, options.max_voxels)) {  // without distant outliers
    extent(blocks, kOutside, low, high);
    while (!fit(*grid, low, high, options.max_voxels)) {
      grid->voxel *= 1.03F;
    }
  }
  std::copy(std::begin(low), std::end(low), grid->origin);
  const std::size_t total = whole(*grid).count();
  grid->marks.assign(total, 0);
  grid->bound.assign(total, 0);
  grid->open = reaches_out(*grid, blocks);
  mark(*grid, blocks, whole(*grid));
  fill_bounds(*grid, whole(*grid));
  if (options.packed) {
    std::vector<std::uint8_t>().swap(grid->marks);
  }
  return grid;
}

bool outgrown(const BoundGrid& grid, BlockList blocks) {
  std::size_t all = 0, outside = 0;
  for (const auto& block : blocks) {
    if (!block) {
      continue;
    }
    all += block->count;
    for (int k = 0; k < 3; ++k) {
      if (block->high[k] < grid.origin[k] ||
          block->low[k] > grid.origin[k] + static_cast<float>(grid.size[k]) * grid.voxel) {
        outside += block->count;
        break;
      }
    }
  }
  return static_cast<double>(outside) > kMostOutside * static_cast<double>(all);
}

void refresh(BoundGrid& grid, BlockList blocks, const float box[6]) {
  const Range range = intersection(voxels_of(grid, box, box + 3), whole(grid));
  const bool unmarked = grid.marks.empty();
  if (unmarked) {
    grid.marks.assign(whole(grid).count(), 0);
    mark(grid, blocks, whole(grid));
  } else if (!range.empty()) {
    clear_marks(grid, range);
    mark(grid, blocks, range);
  }
  const bool open = reaches_out(grid, blocks);
  if (open != grid.open) {
    grid.open = open;
    fill_bounds(grid, whole(grid));
  } else if (!range.empty()) {
    fill_bounds(grid, range);
  }
  if (unmarked) {
    std::vector<std::uint8_t>().swap(grid.marks);
  }
}

}  // namespace splatbot
