// SPDX-License-Identifier: Apache-2.0
#include "entry.hpp"

#define SB_TEXT(name) #name
#define SB_EXPANDED_TEXT(name) SB_TEXT(name)

namespace splatbot::SPLATBOT_KERNELS {

extern const Kernels kKernels;
const Kernels kKernels = {.name = SB_EXPANDED_TEXT(SPLATBOT_KERNELS),
                          .project = project,
                          .blend = blend,
                          .blend_backward = blend_backward,
                          .project_backward = project_backward,
                          .harmonics = harmonics,
                          .harmonics_backward = harmonics_backward,
                          .contributions = contributions,
                          .loss = loss,
                          .adam = adam,
                          .multiply_add = multiply_add,
                          .lanes = SPLATBOT_SIMD / 32};

}  // namespace splatbot::SPLATBOT_KERNELS
