// SPDX-License-Identifier: Apache-2.0
// Checks of arguments that the rasterizers share.
#pragma once

#include <cstdint>
#include <span>
#include <stdexcept>

#include "splatbot/raster_state.hpp"

namespace splatbot {

inline void require(bool ok, const char* what) {
  if (!ok) {
    throw std::invalid_argument(what);
  }
}

template <class T>
bool empty_or(std::span<T> span, std::size_t size) {
  return span.empty() || span.size() == size;
}

inline void check_view(const View& view) {
  constexpr int kMaxTiles = 65535;
  require(view.width > 0 && view.height > 0, "the image has no pixels");
  require(view.width <= kMaxTiles * kTileWidth && view.height <= kMaxTiles * kTileHeight, "the image is too large");
  require(static_cast<std::int64_t>(view.width) * view.height <= (std::int64_t{1} << 31), "the image is too large");
}

}  // namespace splatbot
