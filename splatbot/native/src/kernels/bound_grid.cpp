// SPDX-License-Identifier: Apache-2.0
// Squared distances between voxels and the nearest marked voxel, exact and separable. Two sweeps run along z, then a
// minimum over all relevant shifts along y and x. Cubes n voxels apart are n - 1 voxels from each other.
#include "field_entry.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

constexpr int kReach = kBoundReach;
constexpr int kMost = kReach * kReach;

inline int square_gap(int shift) {
  const int apart = (shift < 0 ? -shift : shift) - 1;
  return apart > 0 ? apart * apart : 0;
}

}  // namespace

void bound_columns(const BoundArgs& a, int y, std::uint8_t* steps) {
  const int width = a.x1 - a.x0;
  const auto row = static_cast<std::size_t>(width);
  const auto out = [&](int z) {
    return a.along_z + (static_cast<std::size_t>(z - a.low[2]) * static_cast<std::size_t>(a.y1 - a.y0) +
                        static_cast<std::size_t>(y - a.y0)) * row;
  };
  const auto marks = [&](int z) {
    return a.marks + (static_cast<std::size_t>(z) * static_cast<std::size_t>(a.size[1]) + static_cast<std::size_t>(y)) *
                         static_cast<std::size_t>(a.size[0]) + a.x0;
  };
  const auto sweep = [&](int z) {
    const std::uint8_t* m = marks(z);
    for (int x = 0; x < width; ++x) {
      const auto next = static_cast<std::uint8_t>(steps[x] < kReach + 1 ? steps[x] + 1 : kReach + 1);
      steps[x] = m[x] != 0 ? std::uint8_t{0} : next;
    }
  };
  const int first = a.low[2] - kReach < 0 ? 0 : a.low[2] - kReach;
  const int last = a.high[2] + kReach < a.size[2] ? a.high[2] + kReach : a.size[2];
  const auto outside = [&](bool rim) { return static_cast<std::uint8_t>(a.open && rim ? 0 : kReach + 1); };
  for (int x = 0; x < width; ++x) {
    steps[x] = outside(first == 0);
  }
  for (int z = first; z < a.high[2]; ++z) {
    sweep(z);
    if (z >= a.low[2]) {
      std::uint8_t* o = out(z);
      for (int x = 0; x < width; ++x) {
        o[x] = steps[x];
      }
    }
  }
  for (int x = 0; x < width; ++x) {
    steps[x] = outside(last == a.size[2]);
  }
  for (int z = last - 1; z >= a.low[2]; --z) {
    sweep(z);
    if (z < a.high[2]) {
      std::uint8_t* o = out(z);
      for (int x = 0; x < width; ++x) {
        const int nearest = o[x] < steps[x] ? o[x] : steps[x];
        const int apart = nearest > 0 ? nearest - 1 : 0;
        o[x] = static_cast<std::uint8_t>(apart * apart);
      }
    }
  }
}

void bound_slice(const BoundArgs& a, int z, std::uint16_t* line) {
  const int width = a.x1 - a.x0;
  std::uint16_t* const row = line + kReach;  // with room on both sides
  std::uint16_t* const best = row + width + kReach;
  for (int x = -kReach; x < 0; ++x) {
    row[x] = a.open && a.x0 == 0 ? 0 : kMost;
    row[width - 1 - x] = a.open && a.x1 == a.size[0] ? 0 : kMost;
  }
  for (int y = a.low[1]; y < a.high[1]; ++y) {
    for (int x = 0; x < width; ++x) {
      row[x] = kMost;
    }
    for (int j = -kReach; j <= kReach; ++j) {
      if (y + j < a.y0 || y + j >= a.y1) {
        if (a.open && (y + j < 0 || y + j >= a.size[1])) {
          const auto f = static_cast<std::uint16_t>(square_gap(j));
          for (int x = 0; x < width; ++x) {
            row[x] = f < row[x] ? f : row[x];
          }
        }
        continue;
      }
      const std::uint8_t* d = a.along_z + (static_cast<std::size_t>(z - a.low[2]) * static_cast<std::size_t>(a.y1 - a.y0) +
                                           static_cast<std::size_t>(y + j - a.y0)) * static_cast<std::size_t>(width);
      const auto f = static_cast<std::uint16_t>(square_gap(j));
      for (int x = 0; x < width; ++x) {
        const auto sum = static_cast<std::uint16_t>(d[x] + f);
        row[x] = sum < row[x] ? sum : row[x];
      }
    }
    for (int x = 0; x < width; ++x) {
      best[x] = kMost;
    }
    for (int j = -kReach; j <= kReach; ++j) {
      const auto f = static_cast<std::uint16_t>(square_gap(j));
      const std::uint16_t* shifted = row + j;
      for (int x = 0; x < width; ++x) {
        const auto sum = static_cast<std::uint16_t>(shifted[x] + f);
        best[x] = sum < best[x] ? sum : best[x];
      }
    }
    std::uint8_t* o = a.bound + (static_cast<std::size_t>(z) * static_cast<std::size_t>(a.size[1]) + static_cast<std::size_t>(y)) *
                                    static_cast<std::size_t>(a.size[0]) + a.low[0];
    for (int x = 0; x < a.high[0] - a.low[0]; ++x) {
      o[x] = static_cast<std::uint8_t>(best[x + a.low[0] - a.x0]);
    }
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
