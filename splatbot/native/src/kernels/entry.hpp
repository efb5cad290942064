// SPDX-License-Identifier: Apache-2.0
// The functions that each instruction set's copy of the kernels defines.
#pragma once

#include "splatbot/kernels.hpp"

namespace splatbot::SPLATBOT_KERNELS {

void project(const ProjectArgs& args, std::size_t block, ProjectedBlock& out);
void blend(const BlendArgs& args, std::size_t tile);
void blend_backward(const BlendBackwardArgs& args, std::size_t tile);
void project_backward(const ProjectBackwardArgs& args, std::size_t block);
void surfel_project(const SurfelProjectArgs& args, std::size_t block, ProjectedBlock& out);
void surfel_blend(const SurfelBlendArgs& args, std::size_t tile);
void surfel_blend_backward(const SurfelBlendBackwardArgs& args, std::size_t tile);
void surfel_project_backward(const SurfelProjectBackwardArgs& args, std::size_t block);
void linearize(const LinearizeArgs& args, LinearizeSums& sums);
void harmonics(const HarmonicsArgs& args, std::size_t block);
void harmonics_backward(const HarmonicsBackwardArgs& args, std::size_t block);
void contributions(const ContributionArgs& args, std::size_t tile);
void medians(const MedianArgs& args, std::size_t tile);
void fronts(const FrontArgs& args, std::size_t tile);
void loss(const LossArgs& args, std::size_t tile, float* scratch, LossSums& sums);
void adam(const AdamGroup& group, const AdamBlock& block);

}  // namespace splatbot::SPLATBOT_KERNELS
