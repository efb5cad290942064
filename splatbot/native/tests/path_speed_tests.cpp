// SPDX-License-Identifier: Apache-2.0
// Speeds along paths, straight, curved, with places that coincide and joints that rest, for the sanitizers to watch.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <stdexcept>
#include <vector>

#include "promises.hpp"
#include "splatbot/path_speed.hpp"

namespace {

using namespace splatbot;

// A straight run of `length` in joint 0 of two: half of it speeding up, or up to the limit of velocity.
void check_line(double length, std::size_t places) {
  std::vector<double> s, first, second, squared(places);
  for (std::size_t i = 0; i < places; ++i) {
    s.push_back(length * static_cast<double>(i) / static_cast<double>(places - 1));
    first.insert(first.end(), {1.0, 0.0});
    second.insert(second.end(), {0.0, 0.0});
  }
  const std::vector<double> velocity = {2.0, 1.0}, acceleration = {10.0, 1.0};
  fastest_speeds({s, first, second, velocity, acceleration}, squared);
  promise(squared.front() == 0.0 && squared.back() == 0.0, "a path begins and ends at rest");
  for (std::size_t i = 0; i < places; ++i) {
    const double most = std::min({4.0, 20.0 * s[i], 20.0 * (length - s[i])});
    promise(squared[i] <= most + 1e-9 && squared[i] >= most - 20.0 * length / static_cast<double>(places),
            "a straight run is as fast as limits let it be");
  }
}

// A wavy path of three joints; every place respects both limits with some acceleration.
void check_waves() {
  constexpr std::size_t places = 500;
  std::vector<double> s, first, second, squared(places);
  for (std::size_t i = 0; i < places; ++i) {
    s.push_back(i == 250 ? s.back() : 0.01 * static_cast<double>(i));  // two places coincide
    const double x = 3.0 * s.back();
    first.insert(first.end(), {std::cos(x), std::sin(x), 0.0});
    second.insert(second.end(), {-3.0 * std::sin(x), 3.0 * std::cos(x), 0.0});
  }
  const std::vector<double> velocity = {1.0, 2.0, 1.0}, acceleration = {4.0, 3.0, 1.0};
  fastest_speeds({s, first, second, velocity, acceleration}, squared);
  for (std::size_t i = 0; i < places; ++i) {
    double low = -1e9, high = 1e9;
    for (std::size_t j = 0; j < 2; ++j) {
      const double d = first[3 * i + j], b = second[3 * i + j] * squared[i];
      promise(std::abs(d) * std::sqrt(squared[i]) <= velocity[j] * (1.0 + 1e-9), "no joint is too fast");
      if (std::abs(d) > 1e-12) {
        const double sign = d < 0.0 ? -1.0 : 1.0;
        low = std::max(low, (-acceleration[j] - sign * b) / std::abs(d));
        high = std::min(high, (acceleration[j] - sign * b) / std::abs(d));
      }
    }
    promise(squared[i] >= 0.0 && low <= high + 1e-6, "some acceleration is within the limits at each place");
  }
}

}  // namespace

void check_path_speed() {
  for (const double length : {1e-6, 0.1, 5.0}) {
    for (const std::size_t places : {std::size_t{2}, std::size_t{3}, std::size_t{200}}) {
      check_line(length, places);
    }
  }
  check_waves();
  bool thrown = false;
  std::vector<double> one = {0.0};
  try {
    fastest_speeds({one, one, one, one, one}, one);
  } catch (const std::invalid_argument&) {
    thrown = true;
  }
  promise(thrown, "a path of one place is refused");
  std::puts("speeds along straight and wavy paths");
}
