// SPDX-License-Identifier: Apache-2.0
#include "bindings.hpp"

#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <cstdint>
#include <optional>
#include <vector>

#include "splatbot/adam.hpp"
#include "splatbot/loss.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Images = nb::ndarray<const float, nb::shape<-1, -1, -1, -1>, nb::c_contig, nb::device::cpu>;
using ImagesOut = nb::ndarray<float, nb::shape<-1, -1, -1, -1>, nb::c_contig, nb::device::cpu>;
using Masks = nb::ndarray<const std::uint8_t, nb::shape<-1, -1, -1>, nb::c_contig, nb::device::cpu>;
using Values = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using ConstValues = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Steps = nb::ndarray<float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Chosen = nb::ndarray<const std::uint8_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

double l1_dssim(const Images& rendered, const Images& target, const std::optional<Masks>& mask, double weight,
                bool inside_only, const std::optional<ImagesOut>& gradient) {
  const splatbot::LossImages images = {
      .count = rendered.shape(0),
      .width = static_cast<int>(rendered.shape(2)),
      .height = static_cast<int>(rendered.shape(1)),
      .channels = static_cast<int>(rendered.shape(3)),
      .rendered = std::span(rendered.data(), rendered.size()),
      .target = std::span(target.data(), target.size()),
      .mask = mask ? std::span(mask->data(), mask->size()) : std::span<const std::uint8_t>()};
  const auto out = gradient ? std::span(gradient->data(), gradient->size()) : std::span<float>();
  const nb::gil_scoped_release release;
  return splatbot::l1_dssim(images, {weight, inside_only}, out);
}

std::size_t adam_step(const std::vector<Values>& values, const std::vector<ConstValues>& gradients,
               const std::vector<Values>& first, const std::vector<Values>& second, const std::vector<std::vector<float>>& rates,
               const Chosen& chosen, const Steps& steps, double beta1, double beta2, double eps) {
  const std::size_t n = values.size();
  if (gradients.size() != n || first.size() != n || second.size() != n || rates.size() != n) {
    throw nb::value_error("values, gradients, moments and rates differ in number");
  }
  std::vector<splatbot::AdamParameter> parameters;
  for (std::size_t i = 0; i < n; ++i) {
    parameters.push_back({std::span(values[i].data(), values[i].size()), std::span(first[i].data(), first[i].size()),
                          std::span(second[i].data(), second[i].size()),
                          std::span(gradients[i].data(), gradients[i].size()), std::span(rates[i])});
  }
  const nb::gil_scoped_release release;
  return splatbot::adam_step(parameters, std::span(chosen.data(), chosen.size()), std::span(steps.data(), steps.size()),
                             {beta1, beta2, eps});
}

}  // namespace

void define_optimize(nb::module_& m) {
  m.def("l1_dssim", &l1_dssim, "rendered"_a.noconvert(), "target"_a.noconvert(), nb::arg("mask").noconvert().none(),
        "weight"_a, "inside_only"_a, nb::arg("gradient").noconvert().none(),
        "(1 - w) L1 + w (1 - SSIM) of images (B, H, W, C) under a mask (B, H, W); writes its gradient to rendered.");
  m.def("adam_step", &adam_step, "values"_a.noconvert(), "gradients"_a.noconvert(), "first"_a.noconvert(),
        "second"_a.noconvert(), "rates"_a, "chosen"_a.noconvert(), "steps"_a.noconvert(), "beta1"_a, "beta2"_a, "eps"_a,
        "One step of Adam, in place, of the rows that `chosen` (N,) marks, with each row's own count of `steps`;"
        " rows whose gradient is not finite are left alone, and their number is returned.");
}
