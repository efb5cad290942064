// SPDX-License-Identifier: Apache-2.0
// The planner's kernels, compiled once for each instruction set; see ../kernels.hpp.
#pragma once

#include <cstddef>

namespace splatbot {

inline constexpr std::size_t kPlanLanes = 16;  // rows of coordinates are padded to multiples of this

struct PlanKernels {
  // Squared Euclidean distances of `count` (a multiple of kPlanLanes) points to q; coordinate d of point i is at
  // coordinates[d * stride + i].
  void (*squared_distances)(const float* coordinates, std::size_t stride, std::size_t dims, const float* q,
                            std::size_t count, float* out);
  // The first place from `begin` on where a value is at most `limit`; else `count`, a multiple of kPlanLanes.
  std::size_t (*first_at_most)(const float* values, std::size_t begin, std::size_t count, float limit);
  // The least of `count` values, a multiple of kPlanLanes.
  float (*least)(const float* values, std::size_t count);
};

}  // namespace splatbot
