// SPDX-License-Identifier: Apache-2.0
// Distances from one configuration to many, and the least of them.
#include "planning_entry.hpp"
#include "simd.hpp"

namespace splatbot::SPLATBOT_KERNELS {

void plan_squared_distances(const float* coordinates, std::size_t stride, std::size_t dims, const float* q,
                            std::size_t count, float* out) {
  for (std::size_t i = 0; i < count; i += W) {
    F sum = set1(0.0F);
    for (std::size_t d = 0; d < dims; ++d) {
      const F apart = load(coordinates + d * stride + i) - set1(q[d]);
      sum = fma(apart, apart, sum);
    }
    store(out + i, sum);
  }
}

std::size_t plan_first_at_most(const float* values, std::size_t begin, std::size_t count, float limit) {
  const F most = set1(limit);
  std::size_t i = begin - begin % W;
  std::uint32_t before = (1U << (begin % W)) - 1U;
  for (; i < count; i += W, before = 0) {
    const std::uint32_t met = bits(load(values + i) <= most) & ~before;
    if (met != 0) {
      return i + static_cast<std::size_t>(__builtin_ctz(met));
    }
  }
  return count;
}

float plan_least(const float* values, std::size_t count) {
  F all = set1(__builtin_inff());
  for (std::size_t i = 0; i < count; i += W) {
    all = min(all, load(values + i));
  }
  alignas(64) float lanes[W];
  store(lanes, all);
  float least = lanes[0];
  for (int i = 1; i < W; ++i) {
    least = lanes[i] < least ? lanes[i] : least;
  }
  return least;
}

}  // namespace splatbot::SPLATBOT_KERNELS
