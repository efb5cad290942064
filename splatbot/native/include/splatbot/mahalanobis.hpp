// SPDX-License-Identifier: Apache-2.0
// The smallest Mahalanobis distance from points to a set of Gaussians, by brute force.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace splatbot {

// Gaussians packed for distance queries; immutable, so any number of threads may ask at once.
class MahalanobisField {
 public:
  // means: (N, 3) [m]; whitening: (N, 3, 3) row-major, W = S^-1 R^T of each Gaussian [1/m], so that the distance of a
  // point p is |W (p - mean)|. W is kept as it is: products such as R S^-2 R^T lose flat Gaussians to cancellation.
  MahalanobisField(std::span<const float> means, std::span<const float> whitening);

  // For points (P, 3) [m]: the smallest distance (P) and the lowest index (P) that attains it. No Gaussian, or only ones
  // too far for float: infinity and -1. Points must be finite.
  void nearest(std::span<const float> points, std::span<float> distance, std::span<std::int32_t> index) const;

  std::size_t size() const { return size_; }

  static constexpr int kLanes = 16;

  // One block: kLanes Gaussians, each quantity contiguous over them.
  struct Block {
    float mean[3][kLanes];
    float whitening[9][kLanes];
  };

 private:
  std::size_t size_;
  std::vector<Block> blocks_;
};

}  // namespace splatbot
