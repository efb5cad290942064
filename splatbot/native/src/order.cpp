// SPDX-License-Identifier: Apache-2.0
// Depth order by one radix sort of all Gaussians in view, then tile lists by a stable counting scatter: cheaper than
// sorting (tile, depth) keys, and every list comes out in depth order. Both are stable, so the result is one and the
// same for any division of the work.
#include <algorithm>
#include <bit>
#include <limits>
#include <span>
#include <stdexcept>
#include <utility>

#include "splatbot/raster_state.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {

namespace {

// How keys are cut into digits: as few passes as the range of depths allows, unless there are so many keys that the
// places they go to outgrow the cache.
struct Digits {
  std::uint32_t least;  // of all keys
  unsigned bits, passes;

  std::size_t count() const { return std::size_t{1} << bits; }
  std::size_t of(std::uint32_t key, unsigned pass) const {
    return ((key - least) >> (pass * bits)) & (count() - 1);
  }
};

Digits digits_for(std::uint32_t least, std::uint32_t most, std::size_t size) {
  constexpr unsigned kFew = 11, kMany = 13;
  constexpr std::size_t kCached = std::size_t{1} << 18;
  const auto bits = static_cast<unsigned>(std::bit_width(most - least));
  constexpr std::size_t kWorthwhile = std::size_t{1} << 15;
  const unsigned digit = size >= kWorthwhile && bits > 2 * kFew && bits <= 2 * kMany && size <= kCached ? kMany : kFew;
  return {least, digit, (bits + digit - 1) / digit};
}

// A share of [0, size).
struct Range {
  std::size_t begin, end;
};
Range share(std::size_t size, std::size_t part, std::size_t parts) {
  return {size * part / parts, size * (part + 1) / parts};
}

std::size_t parts_for(std::size_t size, const ThreadPool& pool) {
  constexpr std::size_t kWorthwhile = 8192;
  return std::clamp<std::size_t>(size / kWorthwhile, 1, pool.size());
}

void radix_pass(const KeyedId* from, KeyedId* to, std::size_t size, const Digits& digits, unsigned pass,
                std::uint32_t* histogram, std::size_t parts, ThreadPool& pool) {
  const std::size_t kinds = digits.count();
  pool.run(parts, [&](std::size_t part) {
    std::uint32_t* counts = histogram + part * kinds;
    std::fill_n(counts, kinds, 0U);
    const auto [begin, end] = share(size, part, parts);
    for (std::size_t i = begin; i < end; ++i) {
      ++counts[digits.of(from[i].key, pass)];
    }
  });
  std::uint32_t sum = 0;
  for (std::size_t digit = 0; digit < kinds; ++digit) {
    for (std::size_t part = 0; part < parts; ++part) {
      const std::uint32_t n = histogram[part * kinds + digit];
      histogram[part * kinds + digit] = sum;
      sum += n;
    }
  }
  pool.run(parts, [&](std::size_t part) {
    std::uint32_t* next = histogram + part * kinds;
    const auto [begin, end] = share(size, part, parts);
    for (std::size_t i = begin; i < end; ++i) {
      to[next[digits.of(from[i].key, pass)]++] = from[i];
    }
  });
}

// The least and the greatest key; 0 and 0 of none.
std::pair<std::uint32_t, std::uint32_t> key_range(std::span<const KeyedId> keys) {
  std::uint32_t least = keys.empty() ? 0U : std::numeric_limits<std::uint32_t>::max(), most = 0;
  for (const KeyedId& each : keys) {
    least = std::min(least, each.key);
    most = std::max(most, each.key);
  }
  return {least, most};
}

// Brings the blocks' lists of visible ids together and numbers their pairs.
void compact(TileLists& state, ThreadPool& pool) {
  std::uint32_t visible = 0;
  std::uint64_t pairs = 0;
  for (ProjectedBlock& block : state.blocks) {
    block.first_visible = visible;
    block.first_pair = pairs;
    visible += block.visible;
    pairs += block.pairs;
  }
  if (pairs > std::numeric_limits<std::uint32_t>::max()) {
    throw std::length_error("more than 2^32 (Gaussian, tile) pairs: the Gaussians are too large for this image");
  }
  state.ids.resize(visible);
  state.order.resize(visible);
  state.order_scratch.resize(visible);
  state.pairs.resize(pairs);
  state.masks.resize(pairs);
  pool.run(state.blocks.size(), [&](std::size_t b) {
    const ProjectedBlock& block = state.blocks[b];
    const std::uint32_t* from = state.visible.data() + b * kProjectBlock;
    for (std::uint32_t i = 0; i < block.visible; ++i) {
      const std::uint32_t id = from[i];
      state.ids[block.first_visible + i] = id;
      state.order[block.first_visible + i] = {state.placements[id].depth_bits, id};
    }
  });
}

}  // namespace

void TileLists::resize(std::size_t count, const View& view) {
  columns = (view.width + kTileWidth - 1) / kTileWidth;
  rows = (view.height + kTileHeight - 1) / kTileHeight;
  blocks.resize((count + kProjectBlock - 1) / kProjectBlock);
  placements.resize(count);
  visible.resize(count);
  tile_done.resize(tiles());
}

std::size_t TileLists::bytes() const noexcept {
  return placements.capacity_bytes() + visible.capacity_bytes() + ids.capacity_bytes() + order.capacity_bytes() +
         order_scratch.capacity_bytes() + histogram.capacity_bytes() + tile_begin.capacity_bytes() +
         pairs.capacity_bytes() + masks.capacity_bytes() + tile_done.capacity_bytes() +
         blocks.capacity() * sizeof(ProjectedBlock);
}

void order_by_depth(TileLists& state, ThreadPool& pool) {
  compact(state, pool);
  const std::size_t size = state.order.size();
  const std::size_t parts = parts_for(size, pool);
  const auto [least, most] = key_range(state.order.span());
  const Digits digits = digits_for(least, most, size);
  state.histogram.resize(parts * digits.count());
  for (unsigned pass = 0; pass < digits.passes; ++pass) {
    radix_pass(state.order.data(), state.order_scratch.data(), size, digits, pass, state.histogram.data(), parts, pool);
    std::swap(state.order, state.order_scratch);
  }
}

void list_tiles(TileLists& state, ThreadPool& pool) {
  const std::size_t tiles = state.tiles();
  const std::size_t size = state.order.size();
  const std::size_t parts = parts_for(size, pool);
  const auto columns = static_cast<std::size_t>(state.columns);
  state.histogram.resize(parts * tiles);
  state.tile_begin.resize(tiles + 1);
  std::uint32_t* histogram = state.histogram.data();

  pool.run(parts, [&](std::size_t part) {
    std::uint32_t* counts = histogram + part * tiles;
    std::fill_n(counts, tiles, 0U);
    const auto [begin, end] = share(size, part, parts);
    for (std::size_t i = begin; i < end; ++i) {
      const Placement& p = state.placements[state.order[i].id];
      for (std::size_t y = p.y0; y < std::size_t{p.y0} + p.ny; ++y) {
        for (std::size_t x = p.x0; x < std::size_t{p.x0} + p.nx; ++x) {
          ++counts[y * columns + x];
        }
      }
    }
  });
  std::uint32_t sum = 0;
  for (std::size_t tile = 0; tile < tiles; ++tile) {
    state.tile_begin[tile] = sum;
    for (std::size_t part = 0; part < parts; ++part) {
      const std::uint32_t n = histogram[part * tiles + tile];
      histogram[part * tiles + tile] = sum;
      sum += n;
    }
  }
  state.tile_begin[tiles] = sum;
  pool.run(parts, [&](std::size_t part) {
    std::uint32_t* next = histogram + part * tiles;
    const auto [begin, end] = share(size, part, parts);
    for (std::size_t i = begin; i < end; ++i) {
      const std::uint32_t id = state.order[i].id;
      const Placement& p = state.placements[id];
      auto slot = static_cast<std::uint32_t>(state.blocks[id / kProjectBlock].first_pair) + p.slot;
      for (std::size_t y = p.y0; y < std::size_t{p.y0} + p.ny; ++y) {
        for (std::size_t x = p.x0; x < std::size_t{p.x0} + p.nx; ++x) {
          state.pairs[next[y * columns + x]++] = {id, slot++};
        }
      }
    }
  });
}

}  // namespace splatbot
