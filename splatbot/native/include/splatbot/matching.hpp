// SPDX-License-Identifier: Apache-2.0
// Matching of 256-bit binary descriptors near their expected places.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

namespace splatbot {

inline constexpr std::size_t kDescriptorBytes = 32;

struct Keypoints {
  std::span<const float> pixels;               // (N, 2)
  std::span<const std::uint8_t> descriptors;   // (N, 32)
};

// For each expected keypoint, the found one with the least Hamming distance within `radius` pixels, or -1. A match is
// rejected beyond max_distance bits, or if the second best is not clearly worse (Lowe's ratio). A found keypoint goes
// to the expected one that is nearest in bits.
void match_near(const Keypoints& expected, const Keypoints& found, float radius, int max_distance, float ratio,
                std::span<std::int32_t> out);

}  // namespace splatbot
