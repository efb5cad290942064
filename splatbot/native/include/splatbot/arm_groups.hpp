// SPDX-License-Identifier: Apache-2.0
// Groups of neighbouring spheres of an arm, and balls that enclose them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace splatbot {

// Groups are sorted by link; none has more than kGroupSize spheres.
struct SphereGroups {
  std::vector<std::int32_t> name;        // (S,) spheres, group by group
  std::vector<std::int32_t> begin;       // (G + 1,) first of each group in name
  std::vector<std::int32_t> link;        // (G,)
  std::vector<std::int32_t> link_begin;  // (J + 2,) first group of each link
  std::vector<double> centers, radii;    // (G, 3) and (G,) of the enclosing balls [m]
};

// Halves the spheres of each link across their longest extent until the groups are small. Links do not decrease.
SphereGroups group_spheres(std::span<const std::int32_t> link, std::span<const double> centers,
                           std::span<const double> radii, std::size_t joints);

// Writes the middle of a ball that encloses the spheres `own` and returns its radius. Ever shorter steps towards the
// farthest sphere approach the smallest ball (Badoiu and Clarkson 2003).
double enclosing_ball(std::span<const std::int32_t> own, std::span<const double> centers, std::span<const double> radii,
                      double* middle);

}  // namespace splatbot
