// SPDX-License-Identifier: Apache-2.0
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <nanobind/stl/array.h>

#include <array>
#include <vector>

#include "bindings.hpp"
#include "splatbot/align.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Image = nb::ndarray<const float, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Rows3 = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Vector = nb::ndarray<const float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>;

template <typename A>
auto view(const A& a) {
  return std::span(a.data(), a.size());
}

nb::object copy(std::span<const double> values, std::initializer_list<std::size_t> shape) {
  auto* data = new std::vector<double>(values.begin(), values.end());
  nb::capsule owner(data, [](void* p) noexcept { delete static_cast<std::vector<double>*>(p); });
  return nb::cast(nb::ndarray<nb::numpy, double>(data->data(), shape, owner));
}

nb::object take(std::vector<float>&& values) {
  auto* data = new std::vector<float>(std::move(values));
  nb::capsule owner(data, [](void* p) noexcept { delete static_cast<std::vector<float>*>(p); });
  return nb::cast(nb::ndarray<nb::numpy, float>(data->data(), {data->size()}, owner));
}

}  // namespace

void define_align(nb::module_& m) {
  m.def(
      "linearize_alignment",
      [](Image gray, Image depth, std::array<double, 4> intrinsics, Rows3 points, Rows3 normals, Vector gray_reference,
         Pose T_current_reference, double gain, double offset, bool photometric, bool geometric, double sigma_gray,
         double sigma_depth_floor, double sigma_depth_quad, double gate) {
        const std::size_t n = gray_reference.size();
        if (points.shape(0) != n || normals.shape(0) != n) throw nb::value_error("points, normals, gray differ in length");
        if (gray.shape(0) != depth.shape(0) || gray.shape(1) != depth.shape(1))
          throw nb::value_error("gray and depth differ in size");
        const auto [fx, fy, cx, cy] = intrinsics;
        const splatbot::AlignImage image{static_cast<int>(gray.shape(1)), static_cast<int>(gray.shape(0)), fx, fy, cx,
                                         cy, view(gray), view(depth)};
        const splatbot::AlignPoints reference{view(points), view(normals), view(gray_reference)};
        splatbot::AlignSettings settings;
        settings.use_photometric = photometric;
        settings.use_geometric = geometric;
        settings.sigma_gray = sigma_gray;
        settings.sigma_depth_floor = sigma_depth_floor;
        settings.sigma_depth_quad = sigma_depth_quad;
        settings.gate = gate;
        std::vector<float> residual_photometric(n), residual_geometric(n);
        const std::span<const double, 16> T(T_current_reference.data(), 16);
        splatbot::AlignSums sums;
        {
          nb::gil_scoped_release release;
          sums = splatbot::linearize_alignment(image, reference, T, gain, offset, settings, residual_photometric,
                                               residual_geometric);
        }
        return nb::make_tuple(copy(sums.H, {8, 8}), copy(sums.g, {8}), sums.cost, sums.projected,
                              take(std::move(residual_photometric)), take(std::move(residual_geometric)));
      },
      "gray"_a.noconvert(), "depth"_a.noconvert(), "intrinsics"_a, "points"_a.noconvert(), "normals"_a.noconvert(),
      "gray_reference"_a.noconvert(), "T_current_reference"_a.noconvert(), "gain"_a, "offset"_a, "photometric"_a,
      "geometric"_a, "sigma_gray"_a, "sigma_depth_floor"_a, "sigma_depth_quad"_a, "gate"_a,
      "Normal equations of one alignment step: (H (8, 8), g (8,), cost, projected, r_photo (N,), r_geo (N,)).");
}
