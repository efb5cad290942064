// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "splatbot/arm_kernels.hpp"

namespace splatbot::SPLATBOT_KERNELS {

void arm_configurations(const ArmView& arm, const SolidsView* field, const double* q, std::size_t begin,
                        std::size_t end, std::int32_t* verdict);
void arm_certify(const ArmView& arm, const SolidsView* field, const double* from, const double* to, float eps,
                 std::size_t begin, std::size_t end, ArmEdge* out);
void arm_sample(const ArmView& arm, const SolidsView* field, const double* from, const double* to, int samples,
                std::size_t begin, std::size_t end, ArmEdge* out);
void arm_centers(const ArmView& arm, const double* q, std::size_t begin, std::size_t end, float* out);

}  // namespace splatbot::SPLATBOT_KERNELS
