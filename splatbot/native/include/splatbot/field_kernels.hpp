// SPDX-License-Identifier: Apache-2.0
// The collision field's kernels, compiled once for each instruction set; see kernels.hpp.
#pragma once

#include <cstddef>
#include <cstdint>

#include "splatbot/solids.hpp"

namespace splatbot {

// Answer for one sphere: the certified signed distance from its surface to an ellipsoid and that ellipsoid. The outward
// normal (the gradient) and the nearest point there follow.
struct NearestSolid {
  double distance;  // [m]; +infinity: none within the cut
  double normal[3];
  double point[3];
  std::int32_t id;  // -1: none
};

struct SphereQueries {
  const double* centers;  // (P, 3) [m]
  const float* radii;     // (P,) [m], or null: 0
};

inline constexpr int kBoundReach = 15;  // [voxels] as far as bounds go; its square fits a byte

// Bounds of the voxels [low, high) from the marks of those up to kBoundReach around them.
struct BoundArgs {
  const std::uint8_t* marks;  // (nz, ny, nx): 1 where an ellipsoid may be
  std::int32_t size[3];       // nx, ny, nz
  bool open;                  // something may be anywhere outside of the grid
  std::int32_t low[3], high[3];
  std::int32_t x0, x1, y0, y1;  // low and high with their surroundings
  std::uint8_t* along_z;        // scratch (high z - low z, y1 - y0, x1 - x0): squared distances along z
  std::uint8_t* bound;          // output, as marks
};

struct FieldKernels {
  // Writes 1 if a sphere may touch an ellipsoid, else 0, which is proven.
  void (*hits)(const SolidsView&, const SphereQueries&, std::size_t begin, std::size_t end, std::uint8_t* out);
  // The nearest ellipsoid, as far as `cut` [m] from the surface of the sphere.
  void (*nearest)(const SolidsView&, const SphereQueries&, float cut, std::size_t begin, std::size_t end,
                  NearestSolid* out);
  // The k nearest, nearest first: (P, k) distances (+infinity: none) and ids.
  void (*k_nearest)(const SolidsView&, const SphereQueries&, int k, float cut, std::size_t begin, std::size_t end,
                    double* distance, std::int32_t* id);
  // The smallest Mahalanobis distance and the lowest id that attains it; infinity and -1 in an empty field. Answers
  // points order[begin] to order[end - 1], fastest if successive points are near each other.
  void (*mahalanobis)(const SolidsView&, const SolidCoversView&, const double* points, const std::uint32_t* order,
                      std::size_t begin, std::size_t end, double* distance, std::int32_t* id);
  // A proven lower bound of the signed distance at each point, from the grid alone; 0 outside of it.
  void (*grid_bounds)(const SolidsView&, const double* points, std::size_t begin, std::size_t end, float* out);
  // A line of columns of a grid, then a slice of it; steps: x1 - x0 bytes, line: 2 (x1 - x0) + 2 kBoundReach.
  void (*bound_columns)(const BoundArgs&, int y, std::uint8_t* steps);
  void (*bound_slice)(const BoundArgs&, int z, std::uint16_t* line);
};

inline constexpr int kMostNearest = 64;

}  // namespace splatbot
