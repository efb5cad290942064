// SPDX-License-Identifier: Apache-2.0
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <optional>
#include <tuple>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "splatbot/align.hpp"

using namespace nb::literals;

namespace {

using Image = nb::ndarray<const float, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Rows3 = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Vector = nb::ndarray<const float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>;
using Points = nb::ndarray<const double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Pixels = nb::ndarray<const double, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Intrinsics = std::array<double, 4>;

template <std::size_t N, typename A>
auto fixed(const A& a) {
  return std::span<const double, N>(a.data(), N);
}

nb::object copy(std::span<const double> values, std::initializer_list<std::size_t> shape) {
  return nb::cast(owned(std::vector<double>(values.begin(), values.end()), shape));
}

splatbot::AlignImage image_of(const Image& gray, const Image& depth, const Intrinsics& k) {
  if (gray.shape(0) != depth.shape(0) || gray.shape(1) != depth.shape(1))
    throw nb::value_error("gray and depth differ in size");
  return {static_cast<int>(gray.shape(1)), static_cast<int>(gray.shape(0)), k[0], k[1], k[2], k[3], span_of(gray), span_of(depth)};
}

splatbot::AlignPoints points_of(const Rows3& points, const Rows3& normals, const Vector& gray) {
  if (points.shape(0) != gray.size() || normals.shape(0) != gray.size())
    throw nb::value_error("points, normals, gray differ in length");
  return {span_of(points), span_of(normals), span_of(gray)};
}

// Arguments from Python. The caller's tuples keep the arrays alive during the call.
using LevelArrays = std::tuple<Image, Image, Intrinsics>;
using PointArrays = std::tuple<Rows3, Rows3, Vector>;
using ReferenceArrays = std::pair<Pose, std::vector<PointArrays>>;
using Sigmas = nb::ndarray<const double, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using MatchArrays = std::tuple<Points, Pixels, Sigmas, Intrinsics>;
using Information = nb::ndarray<const double, nb::shape<6, 6>, nb::c_contig, nb::device::cpu>;
using PriorArrays = std::pair<Pose, Information>;

}  // namespace

void define_align(nb::module_& m) {
  nb::class_<splatbot::AlignSettings>(m, "AlignSettings")
      .def(
          "__init__",
          [](splatbot::AlignSettings* self, bool photometric, bool geometric, double sigma_gray,
             double sigma_depth_floor, double sigma_depth_quad, double gate, const std::array<double, 6>& blur) {
            new (self) splatbot::AlignSettings{.use_photometric = photometric,
                                               .use_geometric = geometric,
                                               .sigma_gray = sigma_gray,
                                               .sigma_depth_floor = sigma_depth_floor,
                                               .sigma_depth_quad = sigma_depth_quad,
                                               .gate = gate,
                                               .blur = blur};
          },
          "photometric"_a, "geometric"_a, "sigma_gray"_a, "sigma_depth_floor"_a, "sigma_depth_quad"_a, "gate"_a, "blur"_a = std::array<double, 6>{});
  m.def(
      "linearize_alignment",
      [](Image gray, Image depth, Intrinsics intrinsics, Rows3 points, Rows3 normals, Vector gray_reference,
         Pose T_current_reference, double gain, double offset, const splatbot::AlignSettings& settings) {
        const splatbot::AlignImage image = image_of(gray, depth, intrinsics);
        const splatbot::AlignPoints reference = points_of(points, normals, gray_reference);
        std::vector<float> residual_photometric(gray_reference.size()), residual_geometric(gray_reference.size());
        splatbot::AlignSums sums;
        {
          nb::gil_scoped_release release;
          sums = splatbot::linearize_alignment(image, reference, fixed<16>(T_current_reference), gain, offset, settings,
                                               residual_photometric, residual_geometric);
        }
        return nb::make_tuple(copy(sums.H, {8, 8}), copy(sums.g, {8}), sums.cost, sums.projected,
                              owned(std::move(residual_photometric), {gray_reference.size()}), owned(std::move(residual_geometric), {gray_reference.size()}));
      },
      "gray"_a.noconvert(), "depth"_a.noconvert(), "intrinsics"_a, "points"_a.noconvert(), "normals"_a.noconvert(),
      "gray_reference"_a.noconvert(), "T_current_reference"_a.noconvert(), "gain"_a, "offset"_a, "settings"_a,
      "Normal equations of one alignment step: (H (8, 8), g (8,), cost, projected, r_photo (N,), r_geo (N,)).");
  m.def(
      "align_residuals",
      [](Image gray, Image depth, Intrinsics intrinsics, Rows3 points, Rows3 normals, Vector gray_reference,
         Pose T_current_reference, const splatbot::AlignSettings& settings) {
        const splatbot::AlignImage image = image_of(gray, depth, intrinsics);
        const splatbot::AlignPoints reference = points_of(points, normals, gray_reference);
        std::vector<float> photometric(gray_reference.size()), geometric(gray_reference.size());
        std::array<double, 2> exposure;
        {
          nb::gil_scoped_release release;
          exposure = splatbot::align_residuals(image, reference, fixed<16>(T_current_reference), settings, photometric,
                                               geometric);
        }
        return nb::make_tuple(owned(std::move(photometric), {gray_reference.size()}),
                              owned(std::move(geometric), {gray_reference.size()}), exposure[0], exposure[1]);
      },
      "gray"_a.noconvert(), "depth"_a.noconvert(), "intrinsics"_a, "points"_a.noconvert(), "normals"_a.noconvert(),
      "gray_reference"_a.noconvert(), "T_current_reference"_a.noconvert(), "settings"_a,
      "Residuals at a pose, with the exposure that fits it: (r_photo (N,), r_geo (N,), gain, offset).");
  m.def(
      "align",
      [](const std::vector<LevelArrays>& levels, const std::vector<ReferenceArrays>& references,
         const std::optional<MatchArrays>& matches, const std::optional<PriorArrays>& prior, Pose T_camera_world,
         const splatbot::AlignSettings& settings, double dense_weight, int iterations, std::size_t finest, double dense_share) {
        std::vector<splatbot::AlignImage> images;
        for (const auto& [gray, depth, intrinsics] : levels) images.push_back(image_of(gray, depth, intrinsics));
        std::vector<splatbot::AlignReference> known;
        for (const auto& [pose, points] : references) {
          if (points.size() != levels.size()) throw nb::value_error("a reference lacks levels of the frame");
          splatbot::AlignReference& reference = known.emplace_back();
          std::copy_n(pose.data(), 16, reference.T_world_reference.begin());
          for (const auto& [p, n, g] : points) reference.levels.push_back(points_of(p, n, g));
        }
        splatbot::AlignMatches match;
        if (matches) {
          const auto& [points, pixels, sigmas, k] = *matches;
          if (points.shape(0) != pixels.shape(0) || points.shape(0) != sigmas.size())
            throw nb::value_error("points, pixels, sigmas differ in length");
          match = {.fx = k[0], .fy = k[1], .cx = k[2], .cy = k[3], .points = span_of(points), .pixels = span_of(pixels), .sigmas = span_of(sigmas)};
        }
        splatbot::AlignPrior known_before;
        if (prior) {
          std::copy_n(prior->first.data(), 16, known_before.T_camera_world.begin());
          std::copy_n(prior->second.data(), 36, known_before.information.begin());
        }
        const splatbot::AlignPlan plan{
            .settings = settings, .dense_weight = dense_weight, .iterations = iterations, .finest = finest,
            .dense_share = dense_share};
        splatbot::AlignResult result;
        {
          nb::gil_scoped_release release;
          result = splatbot::align(images, known, match, prior ? &known_before : nullptr, fixed<16>(T_camera_world), plan);
        }
        return nb::make_tuple(copy(result.T_camera_world, {4, 4}), copy(result.H, {6, 6}), copy(result.curvature, {6, 6}), copy(result.spread, {6, 6}),
                              result.cells, result.dense_weight, result.match_weight,
                              copy(result.band_H, {splatbot::kAlignCellRows, 6, 6}), copy(result.band_g, {splatbot::kAlignCellRows, 6}));
      },
      "levels"_a, "references"_a, "matches"_a.none(), "prior"_a.none(), "T_camera_world"_a.noconvert(), "settings"_a, "dense_weight"_a,
      "iterations"_a, "finest"_a, "dense_share"_a,
      "Gauss-Newton over the levels (gray, depth, (fx, fy, cx, cy)), fine to coarse, against references (T_world_reference, "
      "[(points, normals, gray)] per level) matches (points, pixels, sigmas, (fx, fy, cx, cy)) and a prior (T_camera_world, information (6, 6)). Returns "
      "(T_camera_world, H (6, 6), curvature (6, 6), spread (6, 6), cells, dense_weight, match_weight, band_H (6, 6, 6), band_g (6, 6) of the rows of cells).");
}
