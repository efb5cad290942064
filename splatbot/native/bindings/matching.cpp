// SPDX-License-Identifier: Apache-2.0
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "splatbot/matching.hpp"

using namespace nb::literals;

namespace {

using Pixels = nb::ndarray<const float, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
using Descriptors = nb::ndarray<const std::uint8_t, nb::shape<-1, 32>, nb::c_contig, nb::device::cpu>;

splatbot::Keypoints view(const Pixels& pixels, const Descriptors& descriptors) {
  if (pixels.shape(0) != descriptors.shape(0)) throw nb::value_error("pixels and descriptors differ in length");
  return {span_of(pixels), span_of(descriptors)};
}

}  // namespace

void define_matching(nb::module_& m) {
  m.def(
      "match_near",
      [](Pixels expected, Descriptors expected_descriptors, Pixels found, Descriptors found_descriptors, float radius,
         int max_distance, float ratio) {
        const splatbot::Keypoints wanted = view(expected, expected_descriptors), seen = view(found, found_descriptors);
        return filled<std::int32_t>({expected.shape(0)}, [&](std::span<std::int32_t> matches) {
          splatbot::match_near(wanted, seen, radius, max_distance, ratio, matches);
        });
      },
      "expected"_a.noconvert(), "expected_descriptors"_a.noconvert(), "found"_a.noconvert(),
      "found_descriptors"_a.noconvert(), "radius"_a, "max_distance"_a, "ratio"_a,
      "Index (M,) of the found keypoint that matches each expected one, -1 where none does.");
}
