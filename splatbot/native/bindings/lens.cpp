// SPDX-License-Identifier: Apache-2.0
#include "splatbot/lens.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/string.h>

#include <algorithm>
#include <array>
#include <stdexcept>
#include <string>

#include "arrays.hpp"
#include "bindings.hpp"

using namespace nb::literals;

namespace {

splatbot::CameraModel model_of(const std::string& name) {
  using splatbot::CameraModel;
  return choice_of<CameraModel>("model", name,
                                {{"pinhole", CameraModel::pinhole}, {"ortho", CameraModel::ortho}, {"fisheye", CameraModel::fisheye}});
}

splatbot::Lens unscented(const std::string& model, const std::array<double, 6>& radial,
                         const std::array<double, 2>& tangential, const std::array<double, 4>& thin_prism,
                         double limit, double nearest, const std::array<double, 3>& sigma) {
  splatbot::Lens lens;
  lens.model = model_of(model);
  lens.unscented = true;
  std::copy(radial.begin(), radial.end(), lens.radial);
  std::copy(tangential.begin(), tangential.end(), lens.tangential);
  std::copy(thin_prism.begin(), thin_prism.end(), lens.thin_prism);
  lens.limit = limit;
  lens.nearest = nearest;
  lens.spread = sigma[0];
  lens.weight = sigma[1];
  lens.excess = sigma[2];
  return lens;
}

splatbot::Lens rolling(splatbot::Lens lens, int shutter, const std::array<double, 3>& turn,
                       const std::array<double, 3>& step, const std::array<double, 3>& pivot) {
  if (shutter < 0 || shutter > static_cast<int>(splatbot::Shutter::right_to_left)) {
    throw std::invalid_argument("shutter is not one of the five");
  }
  lens.shutter = static_cast<splatbot::Shutter>(shutter);
  std::copy(turn.begin(), turn.end(), lens.turn);
  std::copy(step.begin(), step.end(), lens.step);
  std::copy(pivot.begin(), pivot.end(), lens.pivot);
  return lens;
}

}  // namespace

void define_lens(nb::module_& m) {
  nb::class_<splatbot::Lens>(m, "Lens", "How a camera maps points of its frame to pixels.")
      .def_static(
          "affine",
          [](const std::string& model) {
            splatbot::Lens lens;
            lens.model = model_of(model);
            return lens;
          },
          "model"_a, "Linearized at each Gaussian's centre: pinhole, ortho or fisheye.")
      .def_static("unscented", &unscented, "model"_a, "radial"_a, "tangential"_a, "thin_prism"_a, "limit"_a,
                  "nearest"_a, "sigma"_a,
                  "With distortion; sigma: spread, weight and excess of the unscented transform.")
      .def("rolling", &rolling, "shutter"_a, "turn"_a, "step"_a, "pivot"_a,
           "A copy with a rolling shutter: 1 top to bottom, 2 left to right, 3 bottom to top, 4 right to left.");
}
