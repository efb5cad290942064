// SPDX-License-Identifier: Apache-2.0
// The collision field: n-sigma ellipsoids under a tree of boxes, and a grid of proven lower bounds of the distance.
// Successive fields share blocks of space. A field is immutable, so any number of threads may query it at once.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <span>
#include <vector>

#include "splatbot/field_kernels.hpp"
#include "splatbot/solids.hpp"

namespace splatbot {

struct FieldOptions {
  float n_sigma = 2.0F;      // where an ellipsoid's surface is
  float voxel = 0.02F;       // [m] of the grid, 0 without a grid; enlarged to respect max_voxels
  std::size_t max_voxels = 2'000'000;
  bool packed = false;  // less memory, larger errors; see packing.hpp
};

// Gaussians as the field takes them. Values must be finite, quaternions not zero, ids not negative.
struct Solids {
  std::span<const float> means;   // (N, 3) [m]
  std::span<const float> quats;   // (N, 4) wxyz, any norm
  std::span<const float> scales;  // (N, 3) standard deviations [m], above 0
  std::span<const std::int32_t> ids;  // (N,), each once
};

// A metric that measures no less than those of some ellipsoids' own, and a ball in it that holds their centers.
struct Cover {
  double center[3];   // world [m], as float32 has them
  double axes[3][3];  // their product with their transpose is the inverse of the metric
  double radius;
  double extent;  // [m] from the center to the ellipsoids' centers
  double thin;    // [1/m] one over the least semi-axis
};

// Made by the first question that needs them.
struct CoverTable {
  std::once_flag once;
  std::vector<SolidCover> nodes;  // in the order of a tree's nodes
  Cover whole{};
  std::atomic<std::size_t> bytes{0};
};

// The Gaussians whose means lie in one cube of space (those too large for a cube: in one block of their own).
struct SolidBlock {
  std::uint64_t key;
  std::size_t count;
  std::vector<SolidLeaf> leaves;   // one of the two is empty
  std::vector<PackedLeaf> packed;
  float corner[3] = {};            // of the packed means
  std::vector<SolidNode> nodes;
  float low[3], high[3], reach[3];
  mutable CoverTable covers;
};

struct BoundGrid {
  std::int32_t size[3];
  float origin[3];
  float voxel;
  bool open;  // some ellipsoid reaches outside: no bound goes beyond the rim
  std::vector<std::uint8_t> marks, bound;  // a packed field keeps no marks
};

class CollisionField {
 public:
  CollisionField(const Solids& solids, const FieldOptions& options);

  // Returns a field of the same options without the ids `removed`, and with `inserted`. An id in both is moved.
  // Unchanged blocks are shared. The answers equal those of a field that is built from scratch.
  std::shared_ptr<const CollisionField> updated(std::span<const std::int32_t> removed, const Solids& inserted) const;

  // Returns a field, without a grid, of the geometry that `earlier` lacks: the obstacles that are new. Ids are not
  // compared.
  std::shared_ptr<const CollisionField> added_since(const CollisionField& earlier) const;

  std::size_t size() const noexcept { return size_; }
  std::size_t bytes() const;         // of leaves, trees, grid and the place of each id
  std::size_t shared_bytes(const CollisionField& other) const;  // of blocks that both hold
  const FieldOptions& options() const noexcept { return options_; }
  const SolidsView& view() const noexcept { return view_; }
  const BoundGrid* grid() const noexcept { return grid_.get(); }

  void hits(const SphereQueries& queries, std::size_t count, std::span<std::uint8_t> out) const;
  void nearest(const SphereQueries& queries, std::size_t count, float cut, std::span<NearestSolid> out) const;
  void k_nearest(const SphereQueries& queries, std::size_t count, int k, float cut, std::span<double> distance,
                 std::span<std::int32_t> id) const;
  void mahalanobis(std::span<const double> points, std::span<double> distance, std::span<std::int32_t> id) const;
  void grid_bounds(std::span<const double> points, std::span<float> out) const;

 private:
  CollisionField() = default;
  void finish();
  SolidCoversView covers() const;
  std::vector<std::int32_t> blocks_by_id() const;

  FieldOptions options_;
  std::size_t size_ = 0;
  std::vector<std::shared_ptr<const SolidBlock>> blocks_;  // a slot stays empty when its last Gaussian goes
  std::vector<std::int32_t> block_of_;                     // by id; -1 if absent. A packed field rebuilds it
  std::vector<SolidNode> top_;
  std::vector<SolidBlockView> views_;
  std::shared_ptr<const BoundGrid> grid_;
  SolidsView view_{};
  mutable CoverTable top_covers_;
  mutable std::vector<const SolidCover*> block_covers_;
};

}  // namespace splatbot
