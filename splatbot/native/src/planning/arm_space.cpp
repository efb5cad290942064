// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/arm_space.hpp"

#include <stdexcept>

namespace splatbot::planning {

ArmSpace::ArmSpace(const Arm& arm, std::shared_ptr<const CollisionField> field, std::span<const double> lower,
                   std::span<const double> upper, float eps)
    : Space(lower, upper), arm_(&arm), field_(std::move(field)), eps_(eps) {
  if (lower.size() != static_cast<std::size_t>(arm.joints())) {
    throw std::invalid_argument("the limits and the arm's joints differ in number");
  }
}

bool ArmSpace::check(const double* a, const double* b) {
  ArmEdge edge;
  arm_->certify(field_.get(), {a, size()}, {b, size()}, eps_, {&edge, 1});
  return edge.verdict == kArmFree;
}

}  // namespace splatbot::planning
