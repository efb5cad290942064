// SPDX-License-Identifier: Apache-2.0
// Checks of arguments that the rasterizers share.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <stdexcept>
#include <string_view>
#include <vector>

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

inline std::optional<Fault> find_fault(const std::vector<ProjectedBlock>& blocks) {
  static constexpr std::string_view kFields[] = {"means", "quats", "scales", "covars", "opacities", "colors"};
  for (const ProjectedBlock& block : blocks) {
    if (block.fault_field >= 0) {
      return Fault{kFields[block.fault_field], block.fault_row};
    }
  }
  return std::nullopt;
}

}  // namespace splatbot
