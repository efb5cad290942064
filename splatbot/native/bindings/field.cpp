// SPDX-License-Identifier: Apache-2.0
#include "splatbot/field.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/shared_ptr.h>

#include <cmath>
#include <limits>

#include "arrays.hpp"
#include "bindings.hpp"

using namespace nb::literals;

namespace {

using splatbot::CollisionField;
using splatbot::NearestSolid;
using Ids = Array<const std::int32_t, nb::shape<-1>>;
using Points = Array<const double, nb::shape<-1, 3>>;
using Radii = std::optional<In1>;

splatbot::Solids solids_of(const InN3& means, const InN4& quats, const InN3& scales, const Ids& ids) {
  const std::size_t n = ids.shape(0);
  if (means.shape(0) != n || quats.shape(0) != n || scales.shape(0) != n) {
    throw nb::value_error("means, quats, scales and ids differ in length");
  }
  for (std::size_t i = 0; i < n; ++i) {
    if (ids(i) < 0) {
      throw nb::value_error("an id is negative");
    }
  }
  return {span_of(means), span_of(quats), span_of(scales), span_of(ids)};
}

splatbot::SphereQueries queries_of(const Points& centers, const Radii& radii) {
  if (radii && radii->shape(0) != centers.shape(0)) {
    throw nb::value_error("centers and radii differ in length");
  }
  return {centers.data(), radii ? radii->data() : nullptr};
}

nb::tuple nearest(const CollisionField& field, const Points& centers, const Radii& radii, float cut) {
  const std::size_t n = centers.shape(0);
  const auto queries = queries_of(centers, radii);
  std::vector<NearestSolid> found(n);
  {
    nb::gil_scoped_release release;
    field.nearest(queries, n, cut, found);
  }
  return nb::make_tuple(column(found, &NearestSolid::distance), column(found, &NearestSolid::normal),
                        column(found, &NearestSolid::point), column(found, &NearestSolid::id));
}

}  // namespace

void define_field(nb::module_& m) {
  nb::class_<CollisionField>(m, "CollisionField", "n-sigma ellipsoids packed for questions about distance; immutable")
      .def(
          "__init__",
          [](CollisionField* self, InN3 means, InN4 quats, InN3 scales, Ids ids, float n_sigma, float voxel,
             std::size_t max_voxels, bool packed) {
            const auto solids = solids_of(means, quats, scales, ids);
            const splatbot::FieldOptions options{n_sigma, voxel, max_voxels, packed};
            nb::gil_scoped_release release;
            new (self) CollisionField(solids, options);
          },
          "means"_a.noconvert(), "quats"_a.noconvert(), "scales"_a.noconvert(), "ids"_a.noconvert(), nb::kw_only(),
          "n_sigma"_a, "voxel"_a, "max_voxels"_a, "packed"_a = false)
      .def(
          "updated",
          [](const CollisionField& self, Ids removed, InN3 means, InN4 quats, InN3 scales, Ids ids) {
            const auto solids = solids_of(means, quats, scales, ids);
            nb::gil_scoped_release release;
            return std::const_pointer_cast<CollisionField>(self.updated(span_of(removed), solids));
          },
          "removed"_a.noconvert(), "means"_a.noconvert(), "quats"_a.noconvert(), "scales"_a.noconvert(),
          "ids"_a.noconvert(), "A field without some ids and with others; unchanged blocks are shared")
      .def(
          "hits",
          [](const CollisionField& self, Points centers, Radii radii) {
            const auto queries = queries_of(centers, radii);
            return filled<std::uint8_t>({centers.shape(0)}, [&](std::span<std::uint8_t> out) {
              self.hits(queries, out.size(), out);
            });
          },
          "centers"_a.noconvert(), "radii"_a.noconvert().none(), "1 where a sphere may touch an ellipsoid")
      .def("nearest", &nearest, "centers"_a.noconvert(), "radii"_a.noconvert().none(), "cut"_a,
           "Signed distance (P), normal (P, 3), nearest point (P, 3) and id (P)")
      .def(
          "k_nearest",
          [](const CollisionField& self, Points centers, Radii radii, int k, float cut) {
            if (k < 1 || k > splatbot::kMostNearest) {
              throw nb::value_error("k is not in 1..64");
            }
            const std::size_t n = centers.shape(0), columns = static_cast<std::size_t>(k);
            const auto queries = queries_of(centers, radii);
            std::vector<double> distance(n * columns);
            std::vector<std::int32_t> id(n * columns);
            {
              nb::gil_scoped_release release;
              self.k_nearest(queries, n, k, cut, distance, id);
            }
            return nb::make_tuple(owned(std::move(distance), {n, columns}), owned(std::move(id), {n, columns}));
          },
          "centers"_a.noconvert(), "radii"_a.noconvert().none(), "k"_a, "cut"_a)
      .def(
          "mahalanobis",
          [](const CollisionField& self, Points points) {
            const std::size_t n = points.shape(0);
            std::vector<double> distance(n);
            std::vector<std::int32_t> id(n);
            {
              nb::gil_scoped_release release;
              self.mahalanobis(span_of(points), distance, id);
            }
            return nb::make_tuple(owned(std::move(distance), {n}), owned(std::move(id), {n}));
          },
          "points"_a.noconvert(), "Smallest Mahalanobis distance (P) and the lowest id that attains it (P)")
      .def(
          "grid_bounds",
          [](const CollisionField& self, Points points) {
            return filled<float>({points.shape(0)},
                                 [&](std::span<float> out) { self.grid_bounds(span_of(points), out); });
          },
          "points"_a.noconvert(), "The grid's lower bound of the distance (P); 0 where it has none")
      .def("grid_cells",
           [](const CollisionField& self) {
             const splatbot::BoundGrid* grid = self.grid();
             return grid != nullptr
                        ? owned(std::vector<std::uint8_t>(grid->bound),
                                {static_cast<std::size_t>(grid->size[2]), static_cast<std::size_t>(grid->size[1]),
                                 static_cast<std::size_t>(grid->size[0])})
                        : owned(std::vector<std::uint8_t>(), {0, 0, 0});
           },
           "Squared bounds in voxels (nz, ny, nx), a copy")
      .def(
          "added_since",
          [](const CollisionField& self, const CollisionField& earlier) {
            nb::gil_scoped_release release;
            return std::const_pointer_cast<CollisionField>(self.added_since(earlier));
          },
          "earlier"_a, "A field of the ellipsoids that an earlier field has not")
      .def("shared_bytes", &CollisionField::shared_bytes, "other"_a)
      .def_prop_ro("bytes", &CollisionField::bytes)
      .def_prop_ro("voxel", [](const CollisionField& self) { return self.grid() != nullptr ? self.grid()->voxel : 0.0F; })
      .def("__len__", &CollisionField::size);
}
