// SPDX-License-Identifier: Apache-2.0
// Covers of the collision field's trees: lower bounds of the distance to the ellipsoids below a node, in their own
// metrics.
//
// Let every covariance S_i of some ellipsoids be at most M (as quadratic forms). Then (p - m_i)' S_i^-1 (p - m_i) is
// at least |p - m_i|^2 in the metric of M^-1. That distance is at least the one to a center less the radius of the
// ball that holds the means. M is the mean of the S_i, enlarged until it covers each. Boxes alone leave most of a
// tree to search: boxes of flat, oblique Gaussians are as long as they are.
#pragma once

#include <span>

#include "solid_grid.hpp"
#include "splatbot/field.hpp"

namespace splatbot {

// The covers of a block's nodes, made at the first call by whichever thread that is.
const CoverTable& covers_of(const SolidBlock& block);

// Those of a tree over blocks, whose covers must have been made.
void cover_top(std::span<const SolidNode> top, BlockList blocks, CoverTable& table);

}  // namespace splatbot
