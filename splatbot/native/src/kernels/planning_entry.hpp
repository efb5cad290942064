// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "splatbot/planning/kernels.hpp"

namespace splatbot::SPLATBOT_KERNELS {

void plan_squared_distances(const float* coordinates, std::size_t stride, std::size_t dims, const float* q,
                            std::size_t count, float* out);
std::size_t plan_first_at_most(const float* values, std::size_t begin, std::size_t count, float limit);
float plan_least(const float* values, std::size_t count);

}  // namespace splatbot::SPLATBOT_KERNELS
