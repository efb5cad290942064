// SPDX-License-Identifier: Apache-2.0
// Random numbers that are the same everywhere for a seed, unlike those of <random>'s distributions.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>

namespace splatbot::planning {

// xoshiro256++ (Blackman and Vigna, "Scrambled linear pseudorandom number generators", 2021), seeded by splitmix64.
class Random {
 public:
  explicit Random(std::uint64_t seed) {
    for (std::uint64_t& word : state_) {
      std::uint64_t z = (seed += 0x9e3779b97f4a7c15ULL);
      z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
      z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
      word = z ^ (z >> 31);
    }
  }

  // In [0, 1).
  double uniform() { return static_cast<double>(next() >> 11) * 0x1p-53; }

  // In [0, count), count > 0.
  std::size_t below(std::size_t count) {
    const auto i = static_cast<std::size_t>(uniform() * static_cast<double>(count));
    return i < count ? i : count - 1;
  }

  // A sample of the standard normal distribution, by the polar method of Marsaglia.
  double normal() {
    for (;;) {
      const double x = 2.0 * uniform() - 1.0, y = 2.0 * uniform() - 1.0;
      const double s = x * x + y * y;
      if (s > 0.0 && s < 1.0) {
        return x * std::sqrt(-2.0 * std::log(s) / s);
      }
    }
  }

 private:
  static std::uint64_t turned(std::uint64_t x, int k) { return (x << k) | (x >> (64 - k)); }

  std::uint64_t next() {
    const std::uint64_t result = turned(state_[0] + state_[3], 23) + state_[0];
    const std::uint64_t t = state_[1] << 17;
    state_[2] ^= state_[0];
    state_[3] ^= state_[1];
    state_[1] ^= state_[2];
    state_[0] ^= state_[3];
    state_[2] ^= t;
    state_[3] = turned(state_[3], 45);
    return result;
  }

  std::uint64_t state_[4];
};

}  // namespace splatbot::planning
