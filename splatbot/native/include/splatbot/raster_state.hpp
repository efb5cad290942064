// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <limits>
#include <vector>

#include "splatbot/buffer.hpp"
#include "splatbot/raster_work.hpp"
#include "splatbot/rasterizer.hpp"

namespace splatbot {

// Tiles are large because each (Gaussian, tile) pair carries an exact mask of the 4x4-pixel blocks it reaches.
#if !defined(SPLATBOT_TILE_WIDTH)
#define SPLATBOT_TILE_WIDTH 32
#define SPLATBOT_TILE_HEIGHT 16
#endif
inline constexpr int kTileWidth = SPLATBOT_TILE_WIDTH;
inline constexpr int kTileHeight = SPLATBOT_TILE_HEIGHT;
inline constexpr int kBlock = 4;
inline constexpr int kBlockColumns = kTileWidth / kBlock;
inline constexpr int kBlockRows = kTileHeight / kBlock;
inline constexpr int kBlocks = kBlockColumns * kBlockRows;  // one bit each in a std::uint32_t
inline constexpr int kBlockPixels = kBlock * kBlock;
inline constexpr int kTilePixels = kTileWidth * kTileHeight;
static_assert(kBlocks <= 32 && kTileHeight % 16 == 0);

// The index of pixel (x, y) in a tile: block by block, 16 pixels to a block, column by column within it. Values that
// depend on a pixel's line alone then repeat every four numbers. Always inlined: the kernels are compiled for several
// CPUs.
__attribute__((always_inline)) inline constexpr int pixel_index(int x, int y) {
  return ((y / kBlock) * kBlockColumns + x / kBlock) * kBlockPixels + (x % kBlock) * kBlock + y % kBlock;
}

// Gaussians are projected in blocks of this many for any number of threads: sums over them are in fixed order.
inline constexpr std::size_t kProjectBlock = 1024;

// Pairs are blended in chunks of this many: one bit each in a std::uint64_t.
inline constexpr int kChunk = 64;

inline constexpr int kRecordChannels = 8;

// Gradient sums of one pair: six moments of the blend exponent, then the channels, then absolute gradients.
inline constexpr int kMoments = 6;
inline constexpr int kSlot = 16;
inline constexpr int kAbsolute = 14;
static_assert(kMoments + kRecordChannels <= kAbsolute && kAbsolute + 2 <= kSlot);

// State that a blend pass keeps of each pixel: transmittance, the channels' sums, the sum of weights.
inline constexpr int kFinalPlanes = 2 + kRecordChannels;
inline constexpr int kWeightPlane = 1 + kRecordChannels;  // for expected depth only

// A projected Gaussian, one cache line. With d = pixel centre - (mx, my), u = l11 dx + l21 dy and w = l22 dy, alpha
// is 2^(lo - u^2 - w^2). (l11 l21; 0 l22) is a root of the inverse 2D covariance times log2(e) / 2, so no digits
// cancel for needles. It reaches the pixels with u^2 + w^2 <= reach^2; `lean` is w at its rightmost point.
struct alignas(64) Record {
  float mx, my, l11, l21, l22, lo, reach, lean;
  float channels[kRecordChannels];  // depth first, if rendered, then colours; for plane depth its slopes come last
};
static_assert(sizeof(Record) == 64);

// Where a Gaussian goes. nx == 0: out of view.
struct Placement {
  std::uint16_t x0, y0, nx, ny;  // tiles
  std::uint32_t slot;            // of its first pair, among those of its projection block
  std::uint32_t depth_bits;
};

struct alignas(64) ProjectedBlock {
  std::uint32_t visible = 0;
  std::uint64_t pairs = 0;
  std::uint64_t first_pair = 0;
  std::uint32_t first_visible = 0;
  std::uint32_t least_key = std::numeric_limits<std::uint32_t>::max(), most_key = 0;  // bits of the depths in view
  int fault_field = -1;  // means, quats, scales, covars, opacities, colors
  std::size_t fault_row = 0;
};

struct KeyedId {
  std::uint32_t key, id;
};

struct Pair {
  std::uint32_t id, slot;
};

// Channels that one blend pass renders. Output column of each; the pass's first may be depth.
struct ChannelPass {
  int count = 0;  // at most kRecordChannels
  bool depth_first = false;
  int first_color = 0;                       // of the input's columns
  std::array<int, kRecordChannels> column{};  // in the rendered image
};

// Tiles of N projected primitives of any shape, and their order.
struct TileLists {
  int columns = 0, rows = 0;  // tiles

  Buffer<Placement> placements;    // (N,)
  Buffer<std::uint32_t> visible;   // ids in view; block b's begin at b * kProjectBlock until compacted
  Buffer<std::uint32_t> ids;       // ids in view, ascending
  std::vector<ProjectedBlock> blocks;

  Buffer<KeyedId> order, order_scratch;
  Buffer<std::uint32_t> histogram;
  Buffer<std::uint32_t> tile_begin;  // (tiles + 1,)
  Buffer<Pair> pairs;                // by tile, front to back
  Buffer<std::uint32_t> masks;       // (pairs,), live blocks reached
  Buffer<std::uint32_t> tile_done;   // (tiles,): pairs looked at before the tile closed

  std::size_t tiles() const noexcept { return static_cast<std::size_t>(columns) * static_cast<std::size_t>(rows); }
  void resize(std::size_t count, const View& view);
  std::size_t bytes() const noexcept;
};

// State that a render of either kind of splat keeps.
template <class SplatRecord, class Options>
struct SplatState : TileLists {
  std::size_t count = 0;
  int channels = 0;  // input columns
  View view{};
  Options options;
  StageTimes times;

  Buffer<SplatRecord> records;  // (N,), in the order of the map
  Buffer<float> final_state;    // (passes, tiles, planes, kTilePixels)
};

struct RasterState : SplatState<Record, RasterOptions> {
  int out_channels = 0;
  std::vector<ChannelPass> passes;

  Buffer<float> more_channels;  // (passes - 1, N, kRecordChannels)
  Buffer<std::uint8_t> mask;    // of square tiles of mask_size pixels; empty: none
  int mask_size = 0, mask_columns = 0;

  std::size_t bytes() const noexcept;
};

// The four passes of either kind of splat, over projection blocks and tiles.
template <class Project, class Blend, class BlendBackward, class ProjectBackward>
struct SplatKernels {
  void (*project)(const Project&, std::size_t block, ProjectedBlock& out);
  void (*blend)(const Blend&, std::size_t tile);
  void (*blend_backward)(const BlendBackward&, std::size_t tile);
  void (*project_backward)(const ProjectBackward&, std::size_t block);
};

// Depth order and tile lists (order.cpp).
class ThreadPool;
void order_by_depth(TileLists& state, ThreadPool& pool);
void list_tiles(TileLists& state, ThreadPool& pool);

}  // namespace splatbot
