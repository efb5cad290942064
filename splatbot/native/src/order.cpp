// SPDX-License-Identifier: Apache-2.0
// Depth order, then tile lists by a stable counting scatter. This is cheaper than sorting (tile, depth) keys, and
// every list comes out in depth order. Each thread sorts a share by radix, and sorted shares are merged in pairs.
// Loops are few, because a sleeping thread takes tens of microseconds to wake. All steps are stable, so the result is
// the same for any division of the work.
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

// Division of keys into digits: as few passes as the range of depths allows, unless the destinations of a digit
// outgrow the cache.
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

// One pass over a share; the counts are of its own.
void radix_pass(std::span<const KeyedId> from, KeyedId* to, const Digits& digits, unsigned pass,
                std::span<std::uint32_t> counts) {
  std::fill(counts.begin(), counts.end(), 0U);
  for (const KeyedId& each : from) {
    ++counts[digits.of(each.key, pass)];
  }
  std::uint32_t sum = 0;
  for (std::uint32_t& count : counts) {
    const std::uint32_t n = count;
    count = sum;
    sum += n;
  }
  for (const KeyedId& each : from) {
    to[counts[digits.of(each.key, pass)]++] = each;
  }
}

// How many of the first k of a merge come from `a`, the first among equals.
std::size_t taken(std::span<const KeyedId> a, std::span<const KeyedId> b, std::size_t k) {
  std::size_t low = k > b.size() ? k - b.size() : 0, high = std::min(k, a.size());
  while (low < high) {
    const std::size_t i = (low + high) / 2;
    if (a[i].key <= b[k - i - 1].key) {
      low = i + 1;
    } else {
      high = i;
    }
  }
  return low;
}

// Entries [begin, end) of a merge. From both ends at once: either chain of comparisons waits for its last.
void merge(std::span<const KeyedId> a, std::span<const KeyedId> b, std::size_t begin, std::size_t end, KeyedId* to) {
  const std::size_t a_begin = taken(a, b, begin), a_end = taken(a, b, end);
  const KeyedId *i = a.data() + a_begin, *i_end = a.data() + a_end;
  const KeyedId *j = b.data() + (begin - a_begin), *j_end = b.data() + (end - a_end);
  KeyedId *head = to + begin, *tail = to + end;
  while (i_end - i > 1 && j_end - j > 1) {  // at least one each way
    const bool second = j->key < i->key;
    *head++ = second ? *j : *i;
    j += second;
    i += !second;
    const bool first = j_end[-1].key < i_end[-1].key;
    *--tail = first ? i_end[-1] : j_end[-1];
    i_end -= first;
    j_end -= !first;
  }
  while (i != i_end && j != j_end) {
    const bool second = j->key < i->key;
    *head++ = second ? *j++ : *i++;
  }
  std::copy(j, j_end, std::copy(i, i_end, head));
}

// Sizes of everything that comes, and where each block's share begins.
void number(TileLists& state) {
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
}

// A contiguous share of the Gaussians in view, brought together from whole blocks and sorted.
struct SortShare {
  std::size_t begin, size;  // of state.order

  SortShare(const TileLists& state, Range blocks) : begin(at(state, blocks.begin)), size(at(state, blocks.end) - begin) {}

  static std::size_t at(const TileLists& state, std::size_t block) {
    return block < state.blocks.size() ? state.blocks[block].first_visible : state.order.size();
  }
};

// Writes ids and, sorted, the share: to order after an even number of passes, else to order_scratch.
void sort_share(TileLists& state, Range blocks, const Digits& digits, std::span<std::uint32_t> counts) {
  const SortShare share(state, blocks);
  KeyedId *from = state.order.data() + share.begin, *to = state.order_scratch.data() + share.begin;
  KeyedId* next = from;
  for (std::size_t b = blocks.begin; b < blocks.end; ++b) {
    const std::uint32_t* ids = state.visible.data() + b * kProjectBlock;
    std::uint32_t* compacted = state.ids.data() + state.blocks[b].first_visible;
    for (std::uint32_t i = 0; i < state.blocks[b].visible; ++i) {
      compacted[i] = ids[i];
      *next++ = {state.placements[ids[i]].depth_bits, ids[i]};
    }
  }
  for (unsigned pass = 0; pass < digits.passes; ++pass) {
    radix_pass({from, share.size}, to, digits, pass, counts);
    std::swap(from, to);
  }
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
  number(state);
  const std::size_t size = state.order.size();
  const std::size_t parts = std::min(parts_for(size, pool), state.blocks.size());
  std::uint32_t least = std::numeric_limits<std::uint32_t>::max(), most = 0;
  for (const ProjectedBlock& block : state.blocks) {
    least = std::min(least, block.least_key);
    most = std::max(most, block.most_key);
  }
  const Digits digits = digits_for(std::min(least, most), most, size);
  state.histogram.resize(parts * digits.count());
  const auto blocks_of = [&](std::size_t first, std::size_t last) {
    return Range{state.blocks.size() * first / parts, state.blocks.size() * last / parts};
  };
  pool.run(parts, [&](std::size_t part) {
    sort_share(state, blocks_of(part, part + 1), digits,
               state.histogram.span().subspan(part * digits.count(), digits.count()));
  });
  if (digits.passes % 2 == 1) {
    std::swap(state.order, state.order_scratch);
  }
  for (std::size_t run = 1; run < parts; run *= 2) {  // parts of a sorted run
    const std::size_t merges = (parts + 2 * run - 1) / (2 * run), pieces = (parts + merges - 1) / merges;
    pool.run(merges * pieces, [&](std::size_t task) {
      const std::size_t first = task / pieces * 2 * run;
      const std::size_t middle = std::min(first + run, parts), last = std::min(first + 2 * run, parts);
      const SortShare a(state, blocks_of(first, middle));
      const std::size_t end = SortShare(state, blocks_of(first, last)).size;
      const std::span<const KeyedId> all{state.order.data() + a.begin, end};
      const auto [from, to] = share(end, task % pieces, pieces);
      merge(all.first(a.size), all.subspan(a.size), from, to, state.order_scratch.data() + a.begin);
    });
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
