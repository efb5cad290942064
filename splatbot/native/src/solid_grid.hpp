// SPDX-License-Identifier: Apache-2.0
// The collision field's grid of proven lower bounds.
#pragma once

#include <memory>
#include <span>
#include <vector>

#include "splatbot/field.hpp"

namespace splatbot {

using BlockList = std::span<const std::shared_ptr<const SolidBlock>>;

// Where most Gaussians are, with room for what is mapped later; null if there is none or options want no grid.
std::shared_ptr<BoundGrid> make_grid(BlockList blocks, const FieldOptions& options);

// Whether so many Gaussians lie outside that a new grid is due.
bool outgrown(const BoundGrid& grid, BlockList blocks);

// Marks and bounds anew as far as they depend on what lies in the box (low 3, high 3) [m].
void refresh(BoundGrid& grid, BlockList blocks, const float box[6]);

}  // namespace splatbot
