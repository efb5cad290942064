// SPDX-License-Identifier: Apache-2.0
// The configurations of an arm: an edge is free if it is certified against the map and the arm itself.
#pragma once

#include <memory>

#include "splatbot/arm.hpp"
#include "splatbot/planning/space.hpp"

namespace splatbot::planning {

class ArmSpace final : public Space {
 public:
  // A field of null: self-collision alone. The arm must outlive this.
  ArmSpace(const Arm& arm, std::shared_ptr<const CollisionField> field, std::span<const double> lower,
           std::span<const double> upper, float eps);

  // Queries another field from now on.
  void look_at(std::shared_ptr<const CollisionField> field) { field_ = std::move(field); }

 protected:
  bool check(const double* a, const double* b) override;

 private:
  const Arm* arm_;
  std::shared_ptr<const CollisionField> field_;
  float eps_;
};

}  // namespace splatbot::planning
