// SPDX-License-Identifier: Apache-2.0
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>

#include <array>
#include <stdexcept>
#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "splatbot/depth.hpp"
#include "splatbot/rectify.hpp"

using namespace nb::literals;

namespace {

using Image = nb::ndarray<const float, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>;
using Intrinsics = std::array<double, 4>;
using Pixels = nb::ndarray<const float, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;

splatbot::DepthImage view(const Image& depth) {
  return {static_cast<int>(depth.shape(1)), static_cast<int>(depth.shape(0)), span_of(depth)};
}

template <class Fill>
nb::ndarray<nb::numpy, float> like(const Image& image, Fill&& fill) {
  return filled<float>({image.shape(0), image.shape(1)}, fill);
}

// Returns an image of the same size, which write() makes of an image and three numbers.
template <void (*write)(const splatbot::DepthImage&, float, float, float, std::span<float>)>
nb::ndarray<nb::numpy, float> filtered(Image depth, float a, float b, float c) {
  return like(depth, [&](std::span<float> out) { write(view(depth), a, b, c, out); });
}

}  // namespace

void define_depth(nb::module_& m) {
  m.def("valid_depth", &filtered<splatbot::valid_depth>, "depth"_a.noconvert(), "near"_a, "far"_a,
        "step"_a, "Depth without implausible and flying pixels.");
  m.def(
      "halve_depth",
      [](Image depth) {
        const std::size_t height = depth.shape(0) / 2, width = depth.shape(1) / 2;
        return filled<float>({height, width}, [&](std::span<float> out) { splatbot::halve_depth(view(depth), out); });
      },
      "depth"_a.noconvert(), "Half the size, the nearest surface of each 2x2 block.");
  m.def(
      "depth_around",
      [](Image depth, Pixels pixels) {
        return filled<double>({pixels.shape(0)}, [&](std::span<double> out) {
          splatbot::depth_around(view(depth), span_of(pixels), out);
        });
      },
      "depth"_a.noconvert(), "pixels"_a.noconvert(), "Median depth of the 5x5 pixels around each; NaN where two surfaces meet.");
  m.def(
      "gray_of_one_surface",
      [](Image depth, Image gray, float step, float floor, float quad) {
        if (gray.shape(0) != depth.shape(0) || gray.shape(1) != depth.shape(1)) {
          throw std::invalid_argument("gray and depth differ in shape");
        }
        return like(depth, [&](std::span<float> out) {
          splatbot::gray_of_one_surface(view(depth), span_of(gray), step, floor, quad, out);
        });
      },
      "depth"_a.noconvert(), "gray"_a.noconvert(), "step"_a, "floor"_a, "quad"_a,
      "Grey, NaN where surfaces of different depth meet.");
  m.def("smooth_depth", &filtered<splatbot::smooth_depth>, "depth"_a.noconvert(), "step"_a,
        "floor"_a, "quad"_a, "Depth averaged over the 3x3 pixels of each one's surface.");
  m.def(
      "normals_of",
      [](Image depth, double fx, double fy, double cx, double cy) {
        return filled<float>({depth.shape(0), depth.shape(1), 3}, [&](std::span<float> out) {
          splatbot::normals_of(view(depth), {fx, fy, cx, cy}, out);
        });
      },
      "depth"_a.noconvert(), "fx"_a, "fy"_a, "cx"_a, "cy"_a, "Normals by central differences; zero where there is none.");
  m.def(
      "rectify_depth",
      [](Image depth, const Intrinsics& k, const std::array<double, 6>& twist, double readout, double delay,
         Pose T_color_depth) {
        return like(depth, [&](std::span<float> out) {
          splatbot::rectify_depth(view(depth), {k[0], k[1], k[2], k[3]}, {twist, readout, delay},
                                  std::span<const double, 16>(T_color_depth.data(), 16), out);
        });
      },
      "depth"_a.noconvert(), "intrinsics"_a, "twist"_a, "readout"_a, "delay"_a, "T_color_depth"_a.noconvert(),
      "Depth that the colour camera has at the stamp of a frame; 0 where it is missing.");
  m.def(
      "rectify_map",
      [](Image depth, const Intrinsics& k, const std::array<double, 6>& twist, double readout, double delay) {
        return filled<float>({depth.shape(0), depth.shape(1), 2}, [&](std::span<float> out) {
          splatbot::rectify_map(view(depth), {k[0], k[1], k[2], k[3]}, {twist, readout, delay}, out);
        });
      },
      "depth"_a.noconvert(), "intrinsics"_a, "twist"_a, "readout"_a, "delay"_a,
      "Pixels (H, W, 2) of the rolling-shutter image for those of the image at the stamp.");
}
