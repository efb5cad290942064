// SPDX-License-Identifier: Apache-2.0
// The surfels' functions that each instruction set's copy of the kernels defines.
#pragma once

#include "splatbot/kernels.hpp"

namespace splatbot::SPLATBOT_KERNELS {

void surfel_project(const SurfelProjectArgs& args, std::size_t block, ProjectedBlock& out);
void surfel_blend(const SurfelBlendArgs& args, std::size_t tile);
void surfel_blend_backward(const SurfelBlendBackwardArgs& args, std::size_t tile);
void surfel_project_backward(const SurfelProjectBackwardArgs& args, std::size_t block);

}  // namespace splatbot::SPLATBOT_KERNELS
