// SPDX-License-Identifier: Apache-2.0
#include "splatbot/fronts.hpp"

#include <algorithm>
#include <stdexcept>

#include "splats.hpp"

namespace splatbot {

namespace {

// The parts of a finished render that a walk over the tile lists needs.
BlendArgs finished(const RasterState& state) {
  BlendArgs args = list_args(const_cast<RasterState&>(state));  // read only: the structure serves writers as well
  args.transmittance_min = state.options.transmittance_min;
  return args;
}

// A pixel's tile and its place in it, as the kernels number them.
struct Place {
  std::uint32_t tile, pixel, row;
};

Place place_of(const RasterState& state, std::int64_t pixel, std::size_t row) {
  const std::int64_t x = pixel % state.view.width, y = pixel / state.view.width;
  const int at = pixel_index(static_cast<int>(x % kTileWidth), static_cast<int>(y % kTileHeight));
  return {static_cast<std::uint32_t>(y / kTileHeight * state.columns + x / kTileWidth), static_cast<std::uint32_t>(at),
          static_cast<std::uint32_t>(row)};
}

std::vector<Place> by_tile(const RasterState& state, std::span<const std::int64_t> pixels) {
  std::vector<Place> places(pixels.size());
  for (std::size_t i = 0; i < pixels.size(); ++i) {
    if (pixels[i] < 0 || pixels[i] >= static_cast<std::int64_t>(pixels_of(state.view))) {
      throw std::invalid_argument("a pixel lies outside the image");
    }
    places[i] = place_of(state, pixels[i], i);
  }
  std::sort(places.begin(), places.end(),
            [](const Place& a, const Place& b) { return a.tile != b.tile ? a.tile < b.tile : a.pixel < b.pixel; });
  for (std::size_t i = 1; i < places.size(); ++i) {
    if (places[i].tile == places[i - 1].tile && places[i].pixel == places[i - 1].pixel) {
      throw std::invalid_argument("a pixel is listed twice");
    }
  }
  return places;
}

}  // namespace

void median_gaussians(const RasterState& state, std::span<std::int32_t> out) {
  if (out.size() != pixels_of(state.view)) {
    throw std::invalid_argument("the output is not (H, W)");
  }
  const Kernels& k = kernels();
  const MedianArgs args = {.forward = finished(state), .ids = out.data()};
  thread_pool()->run(state.tiles(), [&](std::size_t tile) { k.medians(args, tile); });
}

void front_gaussians(const RasterState& state, std::span<const std::int64_t> pixels, std::size_t depth,
                     std::span<std::int32_t> ids, std::span<float> weights) {
  if (ids.size() != pixels.size() * depth || weights.size() != ids.size()) {
    throw std::invalid_argument("an output is not (P, depth)");
  }
  std::fill(ids.begin(), ids.end(), -1);
  std::fill(weights.begin(), weights.end(), 0.0F);
  if (ids.empty()) {
    return;
  }
  const std::vector<Place> places = by_tile(state, pixels);
  std::vector<std::uint32_t> tile_pixels(state.tiles() + 1), in_tile(places.size()), rows(places.size());
  for (std::size_t i = 0; i < places.size(); ++i) {
    ++tile_pixels[places[i].tile + 1];
    in_tile[i] = places[i].pixel;
    rows[i] = places[i].row;
  }
  for (std::size_t tile = 0; tile < state.tiles(); ++tile) {
    tile_pixels[tile + 1] += tile_pixels[tile];
  }
  const Kernels& k = kernels();
  const FrontArgs args = {.forward = finished(state),
                          .tile_pixels = tile_pixels.data(),
                          .pixels = in_tile.data(),
                          .rows = rows.data(),
                          .depth = depth,
                          .ids = ids.data(),
                          .weights = weights.data()};
  thread_pool()->run(state.tiles(), [&](std::size_t tile) { k.fronts(args, tile); });
}

}  // namespace splatbot
