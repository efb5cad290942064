// SPDX-License-Identifier: Apache-2.0
#include "splatbot/mahalanobis.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <limits>
#include <span>

#include "bindings.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using splatbot::MahalanobisField;
using Rows3 = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Matrices = nb::ndarray<const float, nb::shape<-1, 3, 3>, nb::c_contig, nb::device::cpu>;
using Distances = nb::ndarray<float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Indices = nb::ndarray<std::int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

}  // namespace

void define_mahalanobis(nb::module_& m) {
  nb::class_<MahalanobisField>(m, "MahalanobisField", "Gaussians packed for distance queries")
      .def(
          "__init__",
          [](MahalanobisField* self, Rows3 means, Matrices whitening) {
            if (means.shape(0) != whitening.shape(0)) throw nb::value_error("means and whitening differ in length");
            if (means.shape(0) > static_cast<std::size_t>(std::numeric_limits<std::int32_t>::max() - 16))
              throw nb::value_error("too many Gaussians for 32-bit indices");
            new (self) MahalanobisField({means.data(), means.size()}, {whitening.data(), whitening.size()});
          },
          "means"_a.noconvert(), "whitening"_a.noconvert())
      .def(
          "nearest",
          [](const MahalanobisField& self, Rows3 points, Distances distance, Indices index) {
            if (distance.shape(0) != points.shape(0) || index.shape(0) != points.shape(0))
              throw nb::value_error("points, distance and index differ in length");
            nb::gil_scoped_release release;
            self.nearest({points.data(), points.size()}, {distance.data(), distance.size()},
                         {index.data(), index.size()});
          },
          "points"_a.noconvert(), "distance"_a.noconvert(), "index"_a.noconvert(),
          "Writes the smallest distance and its Gaussian's index for points (P, 3)")
      .def("__len__", &MahalanobisField::size);
}
