// SPDX-License-Identifier: Apache-2.0
#include "arm_entry.hpp"
#include "entry.hpp"
#include "field_entry.hpp"
#include "planning_entry.hpp"

#define SB_TEXT(name) #name
#define SB_EXPANDED_TEXT(name) SB_TEXT(name)

namespace splatbot::SPLATBOT_KERNELS {

namespace {
const FieldKernels kField = {field_hits, field_nearest, field_k_nearest, field_mahalanobis,
                             field_grid_bounds, bound_columns, bound_slice};
const ArmKernels kArm = {arm_configurations, arm_certify, arm_sample, arm_centers};
const PlanKernels kPlan = {plan_squared_distances, plan_first_at_most, plan_least};
}  // namespace

extern const Kernels kKernels;
const Kernels kKernels = {
    .name = SB_EXPANDED_TEXT(SPLATBOT_KERNELS),
    .gaussians = {project, blend, blend_backward, project_backward},
    .surfels = {surfel_project, surfel_blend, surfel_blend_backward, surfel_project_backward},
    .linearize = linearize,
    .harmonics = harmonics,
    .harmonics_backward = harmonics_backward,
    .contributions = contributions,
    .medians = medians,
    .fronts = fronts,
    .loss = loss,
    .adam = adam,
    .field = &kField,
    .arm = &kArm,
    .plan = &kPlan,
    .lanes = SPLATBOT_SIMD / 32};

}  // namespace splatbot::SPLATBOT_KERNELS
