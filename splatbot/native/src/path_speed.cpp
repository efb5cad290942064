// SPDX-License-Identifier: Apache-2.0
#include "splatbot/path_speed.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

namespace splatbot {

namespace {

// The constraints on (u, x) = (d2s/dt2, (ds/dt)^2) at one place: lower + lower_slope x <= u <= upper + upper_slope x.
struct Line {
  double at, slope;
};

struct Place {
  std::vector<Line> upper, lower;
  double most;  // of x
};

void constrain(const PathShape& path, std::size_t i, Place& place) {
  const std::size_t joints = path.velocity.size();
  place.upper.clear();
  place.lower.clear();
  place.most = 1e300;
  for (std::size_t j = 0; j < joints; ++j) {
    const double d = path.first[i * joints + j], b = path.second[i * joints + j];
    const double v = path.velocity[j], a = path.acceleration[j];
    if (std::abs(d) > 1e-12) {
      place.most = std::min(place.most, v / std::abs(d) * (v / std::abs(d)));
      place.upper.push_back({a / std::abs(d), -b / d});
      place.lower.push_back({-a / std::abs(d), -b / d});
    } else if (std::abs(b) > 1e-12) {
      place.most = std::min(place.most, a / std::abs(b));
    }
  }
}

// The largest x in [0, most] with some u between the lines: u between each pair of them.
double largest(const Place& place) {
  double x = place.most;
  for (const Line& upper : place.upper) {
    for (const Line& lower : place.lower) {
      const double room = upper.at - lower.at, fall = lower.slope - upper.slope;
      if (fall > 0.0) {
        x = std::min(x, room / fall);
      }
    }
  }
  return std::max(x, 0.0);
}

}  // namespace

void fastest_speeds(const PathShape& path, std::span<double> squared) {
  const std::size_t n = path.s.size(), joints = path.velocity.size();
  if (n < 2 || joints < 1 || path.acceleration.size() != joints || path.first.size() != n * joints ||
      path.second.size() != n * joints || squared.size() != n) {
    throw std::invalid_argument("places, derivatives and limits differ in number");
  }
  Place place;
  std::vector<double> most(n, 0.0);  // from which the end can be reached; all below can too
  for (std::size_t i = n - 1; i-- > 0;) {
    const double twice = 2.0 * (path.s[i + 1] - path.s[i]);
    constrain(path, i, place);
    if (twice <= 0.0) {
      most[i] = std::min(most[i + 1], largest(place));
      continue;
    }
    place.upper.push_back({most[i + 1] / twice, -1.0 / twice});
    place.lower.push_back({0.0, -1.0 / twice});
    most[i] = largest(place);
  }
  squared[0] = 0.0;
  for (std::size_t i = 0; i + 1 < n; ++i) {
    const double x = squared[i], twice = 2.0 * (path.s[i + 1] - path.s[i]);
    constrain(path, i, place);
    double u = 1e300;
    for (const Line& upper : place.upper) {
      u = std::min(u, upper.at + upper.slope * x);
    }
    squared[i + 1] = std::clamp(twice > 0.0 ? x + twice * u : x, 0.0, most[i + 1]);
  }
}

}  // namespace splatbot
