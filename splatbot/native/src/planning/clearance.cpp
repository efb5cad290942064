// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/clearance.hpp"

#include <algorithm>
#include <cmath>
#include <queue>
#include <vector>

namespace splatbot::planning {

namespace {

constexpr double kClose = 0.1;    // relative difference of the bounds to be content with
constexpr double kFinest = 5e-4;  // [m] and absolute

struct Stretch {
  double bound, middle, half, moves;  // `moves`: farthest that any sphere goes along the whole edge [m]
  std::size_t edge;
};

struct Wider {
  bool operator()(const Stretch& a, const Stretch& b) const { return a.bound > b.bound; }
};

}  // namespace

PathClearance path_clearance(const Arm& arm, const CollisionField& field, std::span<const double> path, double cut, int most) {
  const auto joints = static_cast<std::size_t>(arm.joints());
  const ArmView& view = arm.view();
  std::vector<double> q(joints);
  PathClearance answer{cut, cut, 0};
  std::priority_queue<Stretch, std::vector<Stretch>, Wider> open;
  const auto ask = [&](Stretch s) {
    for (std::size_t j = 0; j < joints; ++j) {
      const double a = path[s.edge * joints + j], b = path[(s.edge + 1) * joints + j];
      q[j] = a + s.middle * (b - a);
    }
    ArmClearance room;
    const double reach = std::min(cut + s.half * s.moves, 2.0 * cut);
    arm.clearance(field, q, reach, {&room, 1});
    ++answer.asked;
    const double here = std::min(room.distance, reach);
    answer.found = std::min(answer.found, here);
    s.bound = here - s.half * s.moves - 2.0 * kArmRounding;
    open.push(s);
  };
  for (std::size_t e = 0; e + 1 < path.size() / joints; ++e) {
    double moves = 0.0;
    for (int i = view.first_sphere; i < view.spheres; ++i) {
      double sum = 0.0;
      for (std::size_t j = 0; j < joints; ++j) {
        sum += std::abs(path[(e + 1) * joints + j] - path[e * joints + j]) *
               static_cast<double>(view.reach[static_cast<std::size_t>(i) * joints + j]);
      }
      moves = std::max(moves, sum);
    }
    ask({0.0, 0.5, 0.5, moves, e});
  }
  while (!open.empty()) {
    const Stretch s = open.top();
    answer.least = std::min(cut, s.bound);
    if (s.bound >= answer.found - std::max(kFinest, kClose * answer.found) || answer.asked + 2 > most) {
      break;
    }
    open.pop();
    for (const double side : {-0.5, 0.5}) {
      ask({0.0, s.middle + side * s.half, 0.5 * s.half, s.moves, s.edge});
    }
  }
  return answer;
}

}  // namespace splatbot::planning
