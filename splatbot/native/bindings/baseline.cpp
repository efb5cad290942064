// SPDX-License-Identifier: Apache-2.0
#include "bindings.hpp"

#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <optional>
#include <span>

#include "splatbot/scalar_baseline.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <class T>
using Values = nb::ndarray<T, nb::c_contig, nb::device::cpu>;

template <class A>
auto span_of(const A& array) {
  return std::span(array.data(), array.size());
}

void scalar_baseline(const Values<const float>& means, const Values<const float>& quats,
                     const Values<const float>& scales, const Values<const float>& opacities,
                     const Values<const float>& colors, const nb::ndarray<const float, nb::shape<4, 4>, nb::c_contig>& viewmat,
                     const nb::ndarray<const float, nb::shape<3, 3>, nb::c_contig>& K, int width, int height,
                     const Values<float>& out_colors, const Values<float>& out_alphas,
                     const std::optional<Values<const float>>& grad_colors, const Values<float>& grad_of_colors,
                     const Values<float>& grad_opacities, const Values<float>& grad_means2d,
                     const Values<float>& grad_conics) {
  const std::size_t n = opacities.size();
  if (means.size() != 3 * n || quats.size() != 4 * n || scales.size() != 3 * n || colors.size() != 3 * n) {
    throw nb::value_error("means, quats, scales, opacities and colors differ in length");
  }
  splatbot::View view{};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      view.rotation[3 * i + j] = viewmat(i, j);
    }
    view.translation[i] = viewmat(i, 3);
  }
  view.fx = K(0, 0);
  view.fy = K(1, 1);
  view.cx = K(0, 2);
  view.cy = K(1, 2);
  view.width = width;
  view.height = height;
  splatbot::Gaussians g{};
  g.count = n;
  g.channels = 3;
  g.means = span_of(means);
  g.quats = span_of(quats);
  g.scales = span_of(scales);
  g.opacities = span_of(opacities);
  g.colors = span_of(colors);
  const auto grad = grad_colors ? span_of(*grad_colors) : std::span<const float>();
  const splatbot::ScalarGradients out = {span_of(grad_of_colors), span_of(grad_opacities), span_of(grad_means2d),
                                         span_of(grad_conics)};
  const nb::gil_scoped_release release;
  splatbot::scalar_baseline(g, view, {}, span_of(out_colors), span_of(out_alphas), grad, out);
}

}  // namespace

void define_baseline(nb::module_& m) {
  m.def("scalar_baseline", &scalar_baseline, "means"_a.noconvert(), "quats"_a.noconvert(), "scales"_a.noconvert(),
        "opacities"_a.noconvert(), "colors"_a.noconvert(), "viewmat"_a.noconvert(), "K"_a.noconvert(), "width"_a,
        "height"_a, "out_colors"_a.noconvert(), "out_alphas"_a.noconvert(), nb::arg("grad_render").noconvert().none(),
        "grad_colors"_a.noconvert(), "grad_opacities"_a.noconvert(), "grad_means2d"_a.noconvert(),
        "grad_conics"_a.noconvert(), "The rasterizer's model the plain way, to compare with (splatbot bench).");
}
