// SPDX-License-Identifier: Apache-2.0
// Checks of arguments that the rasterizers share.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <stdexcept>
#include <string_view>

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

inline std::size_t color_columns(const Gaussians& g) {
  return static_cast<std::size_t>(g.sh_degree < 0 ? g.channels : 3 * g.coefficients);
}

inline void check_gaussians(const Gaussians& g) {
  require(g.count < (std::size_t{1} << 32) - 1 && g.channels >= 0, "too many Gaussians");
  require(g.means.size() == 3 * g.count, "means is not (N, 3)");
  const bool axes = g.covars.empty();
  require(axes ? g.quats.size() == 4 * g.count : g.quats.empty(), "quats is not (N, 4), or given beside covars");
  require(axes ? g.scales.size() == 3 * g.count : g.scales.empty(), "scales is not (N, 3), or given beside covars");
  require(empty_or(g.covars, 9 * g.count), "covars is not (N, 3, 3)");
  require(g.opacities.size() == g.count, "opacities is not (N,)");
  require(g.sh_degree >= -1 && g.sh_degree <= kMaxHarmonicsDegree, "the degree of the harmonics is not in 0..4");
  require(g.sh_degree < 0 || (g.channels == 3 && g.coefficients >= (g.sh_degree + 1) * (g.sh_degree + 1)),
          "too few coefficients for this degree");
  require(g.colors.size() == g.count * color_columns(g), "colors has a wrong size");
}

inline void check_view(const View& view) {
  constexpr int kMaxTiles = 65535;
  require(view.width > 0 && view.height > 0, "the image has no pixels");
  require(view.width <= kMaxTiles * kTileWidth && view.height <= kMaxTiles * kTileHeight, "the image is too large");
  require(static_cast<std::int64_t>(view.width) * view.height <= (std::int64_t{1} << 31), "the image is too large");
}

// The first input that the projection found not to be finite.
inline std::optional<Fault> find_fault(std::span<const ProjectedBlock> blocks) {
  static constexpr std::string_view kFields[] = {"means", "quats", "scales", "covars", "opacities", "colors"};
  for (const ProjectedBlock& block : blocks) {
    if (block.fault_field >= 0) {
      return Fault{kFields[block.fault_field], block.fault_row};
    }
  }
  return std::nullopt;
}

}  // namespace splatbot
