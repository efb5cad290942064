// SPDX-License-Identifier: Apache-2.0
#include "splatbot/arm_groups.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "splatbot/arm_kernels.hpp"

namespace splatbot {

namespace {

constexpr int kSteps = 64;  // towards the smallest ball

// Orders the spheres of one link and appends where its groups end.
void halve(std::span<std::int32_t> own, std::int32_t first, std::span<const double> centers,
           std::vector<std::int32_t>& begin) {
  if (own.size() <= static_cast<std::size_t>(kGroupSize)) {
    begin.push_back(first + static_cast<std::int32_t>(own.size()));
    return;
  }
  const auto at = [&](std::int32_t s, std::size_t k) { return centers[3 * static_cast<std::size_t>(s) + k]; };
  std::size_t axis = 0;
  double longest = -1.0;
  for (std::size_t k = 0; k < 3; ++k) {
    const auto [low, high] =
        std::minmax_element(own.begin(), own.end(), [&](std::int32_t a, std::int32_t b) { return at(a, k) < at(b, k); });
    if (at(*high, k) - at(*low, k) > longest) {
      longest = at(*high, k) - at(*low, k);
      axis = k;
    }
  }
  std::stable_sort(own.begin(), own.end(), [&](std::int32_t a, std::int32_t b) { return at(a, axis) < at(b, axis); });
  const std::size_t half = own.size() / 2;
  halve(own.first(half), first, centers, begin);
  halve(own.subspan(half), first + static_cast<std::int32_t>(half), centers, begin);
}

}  // namespace

double enclosing_ball(std::span<const std::int32_t> own, std::span<const double> centers, std::span<const double> radii,
                      double* middle) {
  const auto farthest = [&](std::int32_t& which) {
    double most = -1.0;
    for (const std::int32_t s : own) {
      const auto i = static_cast<std::size_t>(s);
      const double d = radii[i] + std::hypot(centers[3 * i] - middle[0], centers[3 * i + 1] - middle[1],
                                             centers[3 * i + 2] - middle[2]);
      if (d > most) {
        most = d;
        which = s;
      }
    }
    return most;
  };
  std::fill(middle, middle + 3, 0.0);
  for (const std::int32_t s : own) {
    for (std::size_t k = 0; k < 3; ++k) {
      middle[k] += centers[3 * static_cast<std::size_t>(s) + k] / static_cast<double>(own.size());
    }
  }
  double best[3] = {middle[0], middle[1], middle[2]};
  std::int32_t which = own.front();
  double least = farthest(which);
  for (int step = 1; step <= kSteps; ++step) {
    for (std::size_t k = 0; k < 3; ++k) {
      middle[k] += (centers[3 * static_cast<std::size_t>(which) + k] - middle[k]) / (step + 1.0);
    }
    const double radius = farthest(which);
    if (radius < least) {
      least = radius;
      std::copy(middle, middle + 3, best);
    }
  }
  std::copy(best, best + 3, middle);
  return least;
}

SphereGroups group_spheres(std::span<const std::int32_t> link, std::span<const double> centers,
                           std::span<const double> radii, std::size_t joints) {
  SphereGroups groups;
  groups.name.resize(link.size());
  std::iota(groups.name.begin(), groups.name.end(), 0);
  groups.begin.push_back(0);
  groups.link_begin.push_back(0);
  for (std::size_t l = 0; l <= joints; ++l) {
    const auto [first, last] = std::equal_range(link.begin(), link.end(), static_cast<std::int32_t>(l));
    if (first != last) {
      const auto from = static_cast<std::size_t>(first - link.begin()), count = static_cast<std::size_t>(last - first);
      halve(std::span(groups.name).subspan(from, count), static_cast<std::int32_t>(from), centers, groups.begin);
    }
    groups.link.resize(groups.begin.size() - 1, static_cast<std::int32_t>(l));
    groups.link_begin.push_back(static_cast<std::int32_t>(groups.link.size()));
  }
  groups.centers.resize(3 * groups.link.size());
  groups.radii.resize(groups.link.size());
  for (std::size_t g = 0; g < groups.link.size(); ++g) {
    const auto first = static_cast<std::size_t>(groups.begin[g]), last = static_cast<std::size_t>(groups.begin[g + 1]);
    groups.radii[g] = 1e-9 + enclosing_ball(std::span(groups.name).subspan(first, last - first), centers, radii,
                                            &groups.centers[3 * g]);
  }
  return groups;
}

}  // namespace splatbot
