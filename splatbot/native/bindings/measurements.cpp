// SPDX-License-Identifier: Apache-2.0
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>

#include <array>
#include <stdexcept>
#include <utility>

#include "arrays.hpp"
#include "bindings.hpp"
#include "splatbot/measurements.hpp"

using namespace nb::literals;

namespace {

using Image = Array<const float, nb::shape<-1, -1>>;
using Points = Array<const double, nb::shape<-1, 3>>;
using Owners = Array<const std::int32_t, nb::shape<-1>>;
using Counts = Array<std::int32_t, nb::shape<-1, 3>>;
using Tolerance = std::pair<double, double>;

}  // namespace

void define_measurements(nb::module_& m) {
  m.def(
      "count_measurements",
      [](Image depth, const std::array<double, 4>& k, Matrix4 T_camera_world, Points points, Owners owners, int view,
         Tolerance agreement, Tolerance passage, Counts counts) {
        if (points.shape(0) != owners.shape(0) || points.shape(0) != counts.shape(0)) {
          throw std::invalid_argument("points, owners and counts differ in length");
        }
        const nb::gil_scoped_release release;
        splatbot::count_measurements({static_cast<int>(depth.shape(1)), static_cast<int>(depth.shape(0)), span_of(depth)},
                                     {k[0], k[1], k[2], k[3]},
                                     std::span<const double, 16>(T_camera_world.data(), 16), span_of(points),
                                     span_of(owners), view, {agreement.first, agreement.second},
                                     {passage.first, passage.second}, span_of(counts));
      },
      "depth"_a.noconvert(), "intrinsics"_a, "T_camera_world"_a.noconvert(), "points"_a.noconvert(),
      "owners"_a.noconvert(), "view"_a, "agreement"_a, "passage"_a, "counts"_a.noconvert(),
      "Add a view to the counts (P, 3) of views that agree with points, that pass them, and that measure there.");
}
