// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/clearance.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "splatbot/kernels.hpp"
#include "splatbot/planning/space.hpp"

namespace splatbot::planning {

namespace {

constexpr std::size_t kLooks = 8;  // configurations of each edge, for an upper bound
constexpr float kEps = 2e-4F;      // [m]
constexpr double kNearly = 0.9;    // share of the observed clearance that is tried first
constexpr int kAtLeast = 2;        // rounds, unless the first one shows some room

// The least room of configurations along the path.
double least_seen(const Arm& arm, const CollisionField& field, std::span<const double> path, double cut) {
  const auto joints = static_cast<std::size_t>(arm.joints());
  const std::size_t edges = path.size() / joints - 1;
  std::vector<double> q;
  for (std::size_t e = 0; e < edges; ++e) {
    for (std::size_t i = 0; i <= kLooks; ++i) {
      for (std::size_t j = 0; j < joints; ++j) {
        const double a = path[e * joints + j], b = path[(e + 1) * joints + j];
        q.push_back(a + static_cast<double>(i) / kLooks * (b - a));
      }
    }
  }
  std::vector<ArmClearance> rooms(q.size() / joints);
  arm.clearance(field, q, cut, rooms);
  double least = cut;
  for (const ArmClearance& room : rooms) {
    least = std::min(least, room.distance);
  }
  return least;
}

}  // namespace

double path_clearance(const Arm& arm, const CollisionField& field, std::span<const double> path, double cut, int rounds,
                      double seconds) {
  const Stop stop(seconds, nullptr);
  const auto joints = static_cast<std::size_t>(arm.joints());
  const std::size_t edges = path.size() / joints - 1;
  ArmView larger = arm.view();
  larger.pairs = 0;
  const auto certified = [&](double margin) {
    larger.margin = std::nextafter(arm.view().margin + static_cast<float>(margin), std::numeric_limits<float>::infinity());
    for (std::size_t e = 0; e < edges; ++e) {
      ArmEdge edge;
      const double* from = path.data() + e * joints;
      kernels().arm->certify(larger, &field.view(), from, from + joints, kEps, 0, 1, &edge);
      if (edge.verdict != kArmFree) {
        return false;
      }
    }
    return true;
  };
  double low = 0.0, high = least_seen(arm, field, path, cut), middle = kNearly * high;
  if (high >= cut && certified(cut)) {
    return cut;
  }
  double longest = 0.0;
  for (int i = 0; i < rounds && high > 0.0; ++i) {
    const double begin = stop.elapsed();
    if ((low > 0.0 || i >= kAtLeast) && begin + longest >= seconds) {
      break;
    }
    (certified(middle) ? low : high) = middle;
    middle = 0.5 * (low + high);
    longest = std::max(longest, stop.elapsed() - begin);
  }
  return low;
}

}  // namespace splatbot::planning
