// SPDX-License-Identifier: Apache-2.0
#include "entry.hpp"

#define SB_TEXT(name) #name
#define SB_EXPANDED_TEXT(name) SB_TEXT(name)

namespace splatbot::SPLATBOT_KERNELS {

extern const Kernels kKernels;
const Kernels kKernels = {SB_EXPANDED_TEXT(SPLATBOT_KERNELS), project, blend, blend_backward, project_backward,
                          loss, adam, multiply_add, SPLATBOT_SIMD / 32};

}  // namespace splatbot::SPLATBOT_KERNELS
