// SPDX-License-Identifier: Apache-2.0
// The Python module of code that only `splatbot bench` runs.
#include <nanobind/stl/string.h>

#include "../bindings/arrays.hpp"
#include "peak.hpp"
#include "scalar_baseline.hpp"

using namespace nb::literals;

namespace {

using FloatMatrix3 = Array<const float, nb::shape<3, 3>>;
using FloatMatrix4 = Array<const float, nb::shape<4, 4>>;

splatbot::View plain_view(const FloatMatrix4& viewmat, const FloatMatrix3& K, int width, int height) {
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
  return view;
}

void scalar_baseline(const InN3& means, const InN4& quats, const InN3& scales, const In1& opacities,
                     const InN3& colors, const FloatMatrix4& viewmat, const FloatMatrix3& K, int width, int height,
                     const OutAny& out_colors, const OutAny& out_alphas, const std::optional<InAny>& grad_render,
                     const OutAny& grad_colors, const OutAny& grad_opacities, const OutAny& grad_means2d,
                     const OutAny& grad_conics) {
  const splatbot::Gaussians g = gaussians_of(means, quats, scales, {}, opacities, InAny(colors), -1);
  if (means.shape(0) != opacities.size() || quats.shape(0) != opacities.size() || scales.shape(0) != opacities.size() ||
      colors.shape(0) != opacities.size()) {
    throw nb::value_error("means, quats, scales, opacities and colors differ in length");
  }
  const splatbot::ScalarGradients out = {span_of(grad_colors), span_of(grad_opacities), span_of(grad_means2d),
                                         span_of(grad_conics)};
  const nb::gil_scoped_release release;
  splatbot::scalar_baseline(g, plain_view(viewmat, K, width, height), {}, span_of(out_colors), span_of(out_alphas),
                            span_of<const float>(grad_render), out);
}

double multiply_add_peak(const std::string& isa, unsigned threads, double milliseconds) {
  const nb::gil_scoped_release release;
  return splatbot::multiply_add_peak(isa, threads, milliseconds);
}

}  // namespace

NB_MODULE(_bench_native, m) {
  m.doc() = "What splatbot's benchmarks compare its C++ core with";
  m.def("scalar_baseline", &scalar_baseline, "means"_a.noconvert(), "quats"_a.noconvert(), "scales"_a.noconvert(),
        "opacities"_a.noconvert(), "colors"_a.noconvert(), "viewmat"_a.noconvert(), "K"_a.noconvert(), "width"_a,
        "height"_a, "out_colors"_a.noconvert(), "out_alphas"_a.noconvert(), nb::arg("grad_render").noconvert().none(),
        "grad_colors"_a.noconvert(), "grad_opacities"_a.noconvert(), "grad_means2d"_a.noconvert(),
        "grad_conics"_a.noconvert(), "The rasterizer's model the plain way, to compare with.");
  m.def("multiply_add_peak", &multiply_add_peak, "isa"_a, "threads"_a, "milliseconds"_a,
        "GFLOP/s of independent multiply-adds with one instruction set on that many threads.");
}
