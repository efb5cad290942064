// SPDX-License-Identifier: Apache-2.0
#include "splatbot/matching.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <numeric>
#include <vector>

// Every CPU that runs the kernels counts bits in one instruction (isa.cpp requires it).
#if defined(__x86_64__)
#define SB_POPCNT __attribute__((target("popcnt")))
#else
#define SB_POPCNT
#endif

namespace splatbot {
namespace {

using Words = std::array<std::uint64_t, 4>;

SB_POPCNT inline int hamming(const Words& a, const Words& b) {
  int bits = 0;
  for (std::size_t i = 0; i < a.size(); ++i) bits += static_cast<int>(__builtin_popcountll(a[i] ^ b[i]));
  return bits;
}

std::vector<Words> words(std::span<const std::uint8_t> descriptors) {
  std::vector<Words> out(descriptors.size() / kDescriptorBytes);
  std::memcpy(out.data(), descriptors.data(), descriptors.size());
  return out;
}

}  // namespace

SB_POPCNT void match_near(const Keypoints& expected, const Keypoints& found, float radius, int max_distance, float ratio,
                std::span<std::int32_t> out) {
  const std::size_t n = found.pixels.size() / 2;
  const std::vector<Words> want = words(expected.descriptors), have = words(found.descriptors);
  // Found keypoints by row: those of a band are one range.
  std::vector<std::uint32_t> order(n);
  std::iota(order.begin(), order.end(), 0U);
  std::stable_sort(order.begin(), order.end(),
                   [&](std::uint32_t a, std::uint32_t b) { return found.pixels[2 * a + 1] < found.pixels[2 * b + 1]; });
  std::vector<float> rows(n);
  for (std::size_t k = 0; k < n; ++k) rows[k] = found.pixels[2 * order[k] + 1];

  constexpr int kNone = 257;
  std::vector<int> claimed(n, kNone);
  std::vector<std::int32_t> owner(n, -1);
  std::fill(out.begin(), out.end(), -1);
  for (std::size_t i = 0; i < out.size(); ++i) {
    const float u = expected.pixels[2 * i], v = expected.pixels[2 * i + 1];
    if (!std::isfinite(u) || !std::isfinite(v)) continue;
    const auto first = std::lower_bound(rows.begin(), rows.end(), v - radius);
    const auto last = std::upper_bound(first, rows.end(), v + radius);
    int best = kNone, second = kNone;
    std::uint32_t match = 0;
    for (auto row = first; row != last; ++row) {
      const std::uint32_t k = order[static_cast<std::size_t>(row - rows.begin())];
      const float du = found.pixels[2 * k] - u, dv = *row - v;
      if (du * du + dv * dv > radius * radius) continue;
      const int distance = hamming(want[i], have[k]);
      if (distance < best) {
        second = best;
        best = distance;
        match = k;
      } else {
        second = std::min(second, distance);
      }
    }
    if (best > max_distance || !(static_cast<float>(best) < ratio * static_cast<float>(second))) continue;
    if (best >= claimed[match]) continue;
    if (owner[match] >= 0) out[static_cast<std::size_t>(owner[match])] = -1;
    claimed[match] = best;
    owner[match] = static_cast<std::int32_t>(i);
    out[i] = static_cast<std::int32_t>(match);
  }
}

}  // namespace splatbot
