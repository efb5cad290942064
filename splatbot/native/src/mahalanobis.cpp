// SPDX-License-Identifier: Apache-2.0
#include "splatbot/mahalanobis.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

// One source, compiled for three instruction sets; the loader picks one. Elsewhere the compiler's baseline serves, and
// under AddressSanitizer too, which is not up yet when the loader picks.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && defined(__gnu_linux__) && \
    !defined(__SANITIZE_ADDRESS__)
#define SPLATBOT_CLONES __attribute__((target_clones("default", "avx2", "avx512f")))
#else
#define SPLATBOT_CLONES
#endif

namespace splatbot {
namespace {

constexpr int kLanes = MahalanobisField::kLanes;
constexpr std::size_t kPoints = 8;  // points that share one pass over the blocks, so that a block is loaded once for them

// Running minimum of one point: per lane the squared distance and the block that holds it.
struct Nearest {
  float squared[kLanes];
  std::int32_t block[kLanes];
};

SPLATBOT_CLONES
void scan(std::span<const MahalanobisField::Block> blocks, const float* points, std::size_t count, Nearest* nearest) {
  for (std::size_t b = 0; b < blocks.size(); ++b) {
    const auto& block = blocks[b];
    for (std::size_t i = 0; i < count; ++i) {
      const float* p = points + 3 * i;
      Nearest& best = nearest[i];
      for (int l = 0; l < kLanes; ++l) {
        const float x = p[0] - block.mean[0][l], y = p[1] - block.mean[1][l], z = p[2] - block.mean[2][l];
        const auto& w = block.whitening;
        const float u = w[0][l] * x + w[1][l] * y + w[2][l] * z;
        const float v = w[3][l] * x + w[4][l] * y + w[5][l] * z;
        const float t = w[6][l] * x + w[7][l] * y + w[8][l] * z;
        const float squared = u * u + v * v + t * t;
        const bool closer = squared < best.squared[l];
        best.squared[l] = closer ? squared : best.squared[l];
        best.block[l] = closer ? static_cast<std::int32_t>(b) : best.block[l];
      }
    }
  }
}

}  // namespace

MahalanobisField::MahalanobisField(std::span<const float> means, std::span<const float> whitening)
    : size_(means.size() / 3), blocks_((size_ + kLanes - 1) / kLanes) {
  for (std::size_t slot = 0; slot < blocks_.size() * kLanes; ++slot) {
    // The last block is filled up with copies of the last Gaussian: they never win, since the lower index does.
    const std::size_t gaussian = std::min(slot, size_ - 1);
    Block& block = blocks_[slot / kLanes];
    for (std::size_t k = 0; k < 3; ++k) block.mean[k][slot % kLanes] = means[3 * gaussian + k];
    for (std::size_t k = 0; k < 9; ++k) block.whitening[k][slot % kLanes] = whitening[9 * gaussian + k];
  }
}

void MahalanobisField::nearest(std::span<const float> points, std::span<float> distance,
                               std::span<std::int32_t> index) const {
  constexpr float kInfinity = std::numeric_limits<float>::infinity();
  const std::size_t total = points.size() / 3;
  Nearest nearest[kPoints];
  for (std::size_t first = 0; first < total; first += kPoints) {
    const std::size_t count = std::min(kPoints, total - first);
    for (Nearest& n : nearest) {
      std::fill(std::begin(n.squared), std::end(n.squared), kInfinity);
      std::fill(std::begin(n.block), std::end(n.block), -1);
    }
    scan(blocks_, points.data() + 3 * first, count, nearest);
    for (std::size_t i = 0; i < count; ++i) {
      float squared = kInfinity;
      std::int32_t gaussian = -1;
      for (int l = 0; l < kLanes; ++l) {
        if (nearest[i].block[l] < 0) continue;
        const std::int32_t candidate = nearest[i].block[l] * kLanes + l;
        if (nearest[i].squared[l] < squared || (nearest[i].squared[l] == squared && candidate < gaussian)) {
          squared = nearest[i].squared[l];
          gaussian = candidate;
        }
      }
      distance[first + i] = std::sqrt(squared);
      index[first + i] = gaussian;
    }
  }
}

}  // namespace splatbot
