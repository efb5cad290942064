// SPDX-License-Identifier: Apache-2.0
// Distances from one configuration to many.
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

}  // namespace splatbot::SPLATBOT_KERNELS
