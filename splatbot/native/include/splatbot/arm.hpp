// SPDX-License-Identifier: Apache-2.0
// A serial arm covered by spheres: where they are, whether they touch each other or the map.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "splatbot/arm_groups.hpp"
#include "splatbot/arm_kernels.hpp"
#include "splatbot/field.hpp"

namespace splatbot {

struct ArmSpec {
  std::span<const double> joints;           // (J, 3, 4): T_before_joint of each joint at 0, row-major
  std::span<const std::uint8_t> prismatic;  // (J,); the others are revolute, about z
  std::span<const double> travel;           // (J,) the largest |q| of each [rad or m]
  std::span<const std::int32_t> link;       // (S,) of each sphere, not decreasing; 0 is the base
  std::span<const double> centers;          // (S, 3) in the link's frame [m]
  std::span<const double> radii;            // (S,) [m]
  std::span<const std::int32_t> pairs;      // (M, 2) links that may not touch
  std::span<const double> base;             // (3, 4) T_world_base
  bool base_in_map;                         // whether the base's spheres are tested against the map
  double margin = 0.0;                      // [m] added to every radius against the map, not against the arm itself
};

// Clearance of one configuration [m] and where it is least.
struct ArmClearance {
  double distance;   // +infinity: none within the cut
  double normal[3];  // gradient with respect to the sphere's centre
  double center[3];  // of that sphere [world]
  std::int32_t sphere, id;
};

class Arm {
 public:
  // Throws std::invalid_argument if sizes do not fit together, or if there are too many joints, spheres or pairs.
  explicit Arm(const ArmSpec& spec);
  Arm(const Arm&) = delete;
  Arm& operator=(const Arm&) = delete;

  int joints() const noexcept { return view_.joints; }
  int spheres() const noexcept { return view_.spheres; }
  const ArmView& view() const noexcept { return view_; }

  // Poses T_world_link (C, J + 1, 4, 4) and centres (C, S, 3) of configurations (C, J), in float64.
  void forward(std::span<const double> q, std::span<double> poses) const;
  void centers(std::span<const double> q, std::span<double> out) const;
  void centers_float(std::span<const double> q, std::span<float> out) const;

  void configurations(const CollisionField* field, std::span<const double> q, std::span<std::int32_t> verdict) const;
  void certify(const CollisionField* field, std::span<const double> from, std::span<const double> to, float eps,
               std::span<ArmEdge> out) const;
  void sample(const CollisionField* field, std::span<const double> from, std::span<const double> to, int samples,
              std::span<ArmEdge> out) const;
  void clearance(const CollisionField& field, std::span<const double> q, double cut, std::span<ArmClearance> out) const;

 private:
  void forward_one(const double* q, double* poses) const;
  ArmClearance clearance_at(const CollisionField& field, const double* poses, double cut) const;
  static void place(const double* poses, std::int32_t link, const double* center, double* at);

  struct Joint {
    double R[9], t[3];
    bool prismatic;
  };
  std::vector<Joint> exact_;
  double base_[12];
  std::vector<double> exact_centers_, exact_radii_;
  std::vector<std::int32_t> link_, pairs_;
  SphereGroups groups_;
  std::vector<ArmJoint> joint_;
  std::vector<float> center_[3], radius_, enclosing_, reach_, link_reach_;
  ArmView view_{};
};

// Added to every radius [m]: float32 puts a sphere's centre no farther than this from where float64 does.
inline constexpr double kArmRounding = 1e-6;

}  // namespace splatbot
