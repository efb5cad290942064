// SPDX-License-Identifier: Apache-2.0
// Points in front of a measured wall, at it, behind it and out of view, and NaN, for the sanitizers to watch.
#include <array>
#include <cstdint>
#include <limits>
#include <vector>

#include "promises.hpp"
#include "splatbot/measurements.hpp"

namespace {

using namespace splatbot;

constexpr std::array<double, 16> kIdentity = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

// Counts of one view of a wall at 1 m with a hole at pixel (0, 0), for points of another view.
std::vector<std::int32_t> counts_of(const std::vector<double>& points, std::int32_t owner) {
  constexpr int kWidth = 8, kHeight = 6;
  std::vector<float> z(kWidth * kHeight, 1.0F);
  z[0] = 0.0F;
  const std::vector<std::int32_t> owners(points.size() / 3, owner);
  std::vector<std::int32_t> counts(points.size(), 0);
  count_measurements({kWidth, kHeight, z}, {10.0, 10.0, 3.5, 2.5}, kIdentity, points, owners, 1, {0.01, 0.0},
                     {0.02, 0.0}, counts);
  return counts;
}

void promise_counts(const std::vector<double>& point, const std::vector<std::int32_t>& counts) {
  promise(counts_of(point, 0) == counts, "a point has the counts of its place");
}

}  // namespace

void check_measurements() {
  promise_counts({0.0, 0.0, 1.005}, {1, 0, 1});
  promise_counts({0.0, 0.0, 0.985}, {0, 0, 1});
  promise_counts({0.0, 0.0, 0.5}, {0, 1, 1});
  promise_counts({0.0, 0.0, 1.5}, {0, 0, 1});
  promise_counts({-0.35, -0.25, 1.0}, {0, 0, 0});  // the hole
  promise_counts({5.0, 0.0, 1.0}, {0, 0, 0});      // out of view
  promise_counts({0.0, 0.0, -1.0}, {0, 0, 0});
  promise_counts({0.0, 0.0, 0.0}, {0, 0, 0});
  promise_counts({kNaN, 0.0, 1.0}, {0, 0, 0});
  promise_counts({0.0, 0.0, kNaN}, {0, 0, 0});
  promise_counts({1e300, 0.0, 1e-300}, {0, 0, 0});
  promise_counts({}, {});
  promise(counts_of({0.0, 0.0, 1.0}, 1) == std::vector<std::int32_t>{0, 0, 0}, "a view does not count for its points");
  std::vector<double> many;
  for (int i = 0; i < 40'000; ++i) many.insert(many.end(), {0.0, 0.0, 1.0});
  const std::vector<std::int32_t> counts = counts_of(many, 0);
  for (std::size_t i = 0; i < counts.size(); ++i) promise(counts[i] == (i % 3 == 1 ? 0 : 1), "each point counts once");
}
