// SPDX-License-Identifier: Apache-2.0
#include "splatbot/surfels.hpp"

#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>

#include <string>

#include "arrays.hpp"
#include "bindings.hpp"

using namespace nb::literals;

namespace {

// A render's leftovers for its backward pass and its meta.
using SurfelHandle = StateHandle<splatbot::SurfelStatePtr>;

nb::object forward(const InN3& means, const InN4& quats, const InN3& scales, const In1& opacities, const InAny& colors,
                   int sh_degree, const Matrix4& viewmat, const Matrix3& K, int width, int height, float near_plane,
                   float far_plane, float radius_clip, const std::string& depth, OrNone<In1> background,
                   const Out3& out_colors, const Out2& out_alphas, const Out3& out_normals, const Out2& out_median,
                   OrNone<Out2> out_distortion) {
  const splatbot::Gaussians surfels = gaussians_of(means, quats, scales, std::nullopt, opacities, colors, sh_degree);
  const splatbot::View view = view_of(viewmat, K, width, height);
  const splatbot::SurfelOptions options = {.near_plane = near_plane,
                                           .far_plane = far_plane,
                                           .radius_clip = radius_clip,
                                           .depth = depth_mode(depth),
                                           .distortion = out_distortion.has_value()};
  const splatbot::SurfelImages out = {.colors = span_of(out_colors),
                                      .alphas = span_of(out_alphas),
                                      .normals = span_of(out_normals),
                                      .median = span_of(out_median),
                                      .distortion = span_of<float>(out_distortion)};
  return state_after<SurfelHandle>([&](auto& state) {
    return splatbot::surfels_forward(surfels, view, options, span_of<const float>(background), out, state);
  });
}

void backward(const SurfelHandle& state, const InN3& means, const InN4& quats, const InN3& scales, const In1& opacities,
              const InAny& colors, int sh_degree, OrNone<In1> background, OrNone<In3> grad_colors,
              OrNone<In2> grad_alphas, OrNone<In3> grad_normals, OrNone<In2> grad_median, OrNone<In2> grad_distortion,
              OrNone<OutAny> out_means, OrNone<OutAny> out_quats, OrNone<OutAny> out_scales,
              OrNone<OutAny> out_opacities, OrNone<OutAny> out_colors, OrNone<OutCamera> out_camera,
              OrNone<OutDoubles> out_background, OrNone<OutAny> out_means2d, bool accumulate) {
  const splatbot::Gaussians surfels = gaussians_of(means, quats, scales, std::nullopt, opacities, colors, sh_degree);
  const splatbot::SurfelImageGradients grads = {.colors = span_of<const float>(grad_colors),
                                                .alphas = span_of<const float>(grad_alphas),
                                                .normals = span_of<const float>(grad_normals),
                                                .median = span_of<const float>(grad_median),
                                                .distortion = span_of<const float>(grad_distortion)};
  const splatbot::Gradients out = gradients_of(out_means, out_quats, out_scales, out_opacities, out_colors, out_camera,
                                               out_background, out_means2d, accumulate);
  const nb::gil_scoped_release release;
  splatbot::surfels_backward(*state.state, surfels, span_of<const float>(background), grads, out);
}

nb::dict describe(const SurfelHandle& state) {
  const std::size_t n = splatbot::surfel_count(*state.state);
  ArrayDict d;
  const splatbot::SurfelProjections out = {d.add<float>("means2d", {n, 2}), d.add<float>("depths", {n}),
                                           d.add<float>("normals", {n, 3}), d.add<std::int32_t>("radii", {n, 2}),
                                           d.add<std::int32_t>("tiles_per_gauss", {n})};
  return d.filled([&] { splatbot::describe_surfels(*state.state, out); });
}

}  // namespace

void define_surfels(nb::module_& m) {
  define_state<SurfelHandle>(m, "SurfelState", "What a render of surfels leaves for its backward pass.", &describe);

  m.attr("MAX_SURFEL_CHANNELS") = splatbot::kMaxSurfelChannels;

  m.def("surfels_forward", &forward, "means"_a.noconvert(), "quats"_a.noconvert(), "scales"_a.noconvert(),
        "opacities"_a.noconvert(), "colors"_a.noconvert(), "sh_degree"_a, "viewmat"_a.noconvert(),
        "K"_a.noconvert(), "width"_a, "height"_a, "near_plane"_a, "far_plane"_a, "radius_clip"_a, "depth"_a,
        or_none("background"), "out_colors"_a.noconvert(), "out_alphas"_a.noconvert(),
        "out_normals"_a.noconvert(), "out_median"_a.noconvert(), or_none("out_distortion"),
        "Render one view of surfels. Returns a SurfelState, or (field, row) of an input that is not finite.");

  m.def("surfels_backward", &backward, "state"_a, "means"_a.noconvert(), "quats"_a.noconvert(),
        "scales"_a.noconvert(), "opacities"_a.noconvert(), "colors"_a.noconvert(), "sh_degree"_a,
        or_none("background"), or_none("grad_colors"), or_none("grad_alphas"), or_none("grad_normals"),
        or_none("grad_median"), or_none("grad_distortion"), or_none("out_means"), or_none("out_quats"),
        or_none("out_scales"), or_none("out_opacities"), or_none("out_colors"), or_none("out_camera"),
        or_none("out_background"), or_none("out_means2d"), "accumulate"_a,
        "Write (or add) the gradients whose arrays are given; that of means2d is never added to.");
}
