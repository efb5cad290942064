// SPDX-License-Identifier: Apache-2.0
// The collision field's grid of proven lower bounds.
#pragma once

#include <memory>
#include <span>
#include <vector>

#include "splatbot/field.hpp"

namespace splatbot {

using BlockList = std::span<const std::shared_ptr<const SolidBlock>>;

// A grid over most Gaussians, with space for later ones; null for an empty field, or if the options disable it.
std::shared_ptr<BoundGrid> make_grid(BlockList blocks, const FieldOptions& options);

// True if enough Gaussians lie outside to require a new grid.
bool outgrown(const BoundGrid& grid, BlockList blocks);

// Updates marks and bounds that depend on the box (low 3, high 3) [m].
void refresh(BoundGrid& grid, BlockList blocks, const float box[6]);

}  // namespace splatbot
