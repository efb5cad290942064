// SPDX-License-Identifier: Apache-2.0
#include "arrays.hpp"
#include "bindings.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>
#include <string>
#include <tuple>

#include "splatbot/fronts.hpp"
#include "splatbot/isa.hpp"
#include "splatbot/raster_work.hpp"
#include "splatbot/rasterizer.hpp"
#include "splatbot/threads.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using State = StateHandle<splatbot::RasterStatePtr>;

nb::object forward(const InN3& means, OrNone<InN4> quats, OrNone<InN3> scales, OrNone<InN33> covars,
                   const In1& opacities, const InAny& colors, int sh_degree, const Matrix4& viewmat, const Matrix3& K,
                   int width, int height, float near_plane, float far_plane, float radius_clip, float eps2d,
                   const std::string& depth, bool plane_depth, bool antialiased, float transmittance_min,
                   OrNone<In1> background, OrNone<InMask> mask, int mask_size, const Out3& out_colors,
                   const Out2& out_alphas, const splatbot::Lens* lens) {
  const splatbot::Gaussians gaussians = gaussians_of(means, quats, scales, covars, opacities, colors, sh_degree);
  const splatbot::View view = view_of(viewmat, K, width, height, lens);
  const splatbot::RasterOptions options = {.near_plane = near_plane,
                                           .far_plane = far_plane,
                                           .radius_clip = radius_clip,
                                           .eps2d = eps2d,
                                           .depth = depth_mode(depth),
                                           .plane_depth = plane_depth,
                                           .antialiased = antialiased,
                                           .transmittance_min = transmittance_min};
  const splatbot::TileMask tiles = {.keep = span_of<const std::uint8_t>(mask), .size = mask_size};
  return state_after<State>([&](auto& state) {
    return splatbot::rasterize_forward(gaussians, view, options, span_of<const float>(background), tiles,
                                       span_of(out_colors), span_of(out_alphas), state);
  });
}

void backward(const State& state, const InN3& means, OrNone<InN4> quats, OrNone<InN3> scales, OrNone<InN33> covars,
              const In1& opacities, const InAny& colors, int sh_degree, OrNone<In1> background, OrNone<In3> grad_render,
              OrNone<In2> grad_alphas, OrNone<OutAny> grad_means, OrNone<OutAny> grad_quats, OrNone<OutAny> grad_scales,
              OrNone<OutAny> grad_covars, OrNone<OutAny> grad_opacities, OrNone<OutAny> grad_colors,
              OrNone<OutCamera> grad_camera, OrNone<OutDoubles> grad_background, OrNone<OutAny> grad_means2d,
              OrNone<OutAny> absolute_means2d, bool accumulate) {
  const splatbot::Gaussians gaussians = gaussians_of(means, quats, scales, covars, opacities, colors, sh_degree);
  splatbot::Gradients out = gradients_of(grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_camera,
                                         grad_background, grad_means2d, accumulate);
  out.covars = span_of<float>(grad_covars);
  out.absolute2d = span_of<float>(absolute_means2d);
  const nb::gil_scoped_release release;
  splatbot::rasterize_backward(*state.state, gaussians, span_of<const float>(background),
                               span_of<const float>(grad_render), span_of<const float>(grad_alphas), out);
}

nb::dict describe(const State& state) {
  const std::size_t n = splatbot::gaussian_count(*state.state);
  ArrayDict d;
  const splatbot::Projections out = {d.add<float>("means2d", {n, 2}), d.add<float>("depths", {n}),
                                     d.add<float>("conics", {n, 3}), d.add<std::int32_t>("radii", {n, 2}),
                                     d.add<float>("opacities", {n})};
  return d.filled([&] { splatbot::describe_projections(*state.state, out); });
}

nb::ndarray<nb::numpy, std::int32_t> contributions(const State& state) {
  return filled<std::int32_t>({splatbot::gaussian_count(*state.state)}, [&](std::span<std::int32_t> counts) {
    splatbot::count_contributions(*state.state, counts);
  });
}

nb::object find_visible(const InN3& means, OrNone<InN4> quats, OrNone<InN3> scales, OrNone<InN33> covars,
                        const In1& opacities, const Matrix4& viewmat, const Matrix3& K, int width, int height,
                        float near_plane, float far_plane, float radius_clip, float eps2d, bool antialiased,
                        const splatbot::Lens* lens) {
  splatbot::Gaussians gaussians = {.count = means.shape(0),
                                   .means = span_of(means),
                                   .quats = span_of<const float>(quats),
                                   .scales = span_of<const float>(scales),
                                   .covars = span_of<const float>(covars),
                                   .opacities = span_of(opacities),
                                   .colors = {}};
  const splatbot::View view = view_of(viewmat, K, width, height, lens);
  const splatbot::RasterOptions options = {.near_plane = near_plane,
                                           .far_plane = far_plane,
                                           .radius_clip = radius_clip,
                                           .eps2d = eps2d,
                                           .antialiased = antialiased};
  std::vector<std::uint32_t> ids;
  return unless_faulty([&] { return splatbot::find_visible(gaussians, view, options, ids); },
                       [&] { return indices_of(ids); });
}

void medians(const State& state, const Array<std::int32_t, nb::shape<-1, -1>>& out) {
  const nb::gil_scoped_release release;
  splatbot::median_gaussians(*state.state, span_of(out));
}

void fronts(const State& state, const Array<const std::int64_t, nb::shape<-1>>& pixels,
            const Array<std::int32_t, nb::shape<-1, -1>>& ids, const Out2& weights) {
  const nb::gil_scoped_release release;
  splatbot::front_gaussians(*state.state, span_of(pixels), ids.shape(1), span_of(ids), span_of(weights));
}

nb::dict work(const State& state) {
  const splatbot::StageTimes& times = splatbot::stage_times(*state.state);
  nb::dict d;
  d["project_ms"] = times.project;
  d["order_ms"] = times.order;
  d["list_tiles_ms"] = times.list_tiles;
  d["blend_ms"] = times.blend;
  d["blend_backward_ms"] = times.blend_backward;
  d["project_backward_ms"] = times.project_backward;
  d["evaluated_pairs"] = splatbot::evaluated_pairs(*state.state);
  return d;
}

}  // namespace

void define_rasterize(nb::module_& m) {
  define_state<State>(m, "RasterState", "What a render leaves for its backward pass.", &describe)
      .def("contributions", &contributions, "In how many pixels (N,) each Gaussian counts.")
      .def_prop_ro("n_visible", [](const State& state) { return splatbot::visible_ids(*state.state).size(); })
      .def("medians", &medians, "out"_a.noconvert(),
           "Write to out (H, W) the Gaussian at which transmittance falls to 1/2, -1 where it does not.")
      .def("fronts", &fronts, "pixels"_a.noconvert(), "ids"_a.noconvert(), "weights"_a.noconvert(),
           "Write the front K Gaussians of pixels (P,), y W + x, to ids and weights (P, K).")
      .def("work", &work, "Milliseconds by stage of the last passes, and the (Gaussian, pixel) pairs of a blend pass.");

  m.def("rasterize_forward", &forward, "means"_a.noconvert(), or_none("quats"), or_none("scales"), or_none("covars"),
        "opacities"_a.noconvert(), "colors"_a.noconvert(), "sh_degree"_a, "viewmat"_a.noconvert(), "K"_a.noconvert(),
        "width"_a, "height"_a, "near_plane"_a, "far_plane"_a, "radius_clip"_a, "eps2d"_a, "depth"_a, "plane_depth"_a,
        "antialiased"_a, "transmittance_min"_a, or_none("background"), or_none("mask"), "mask_size"_a,
        "out_colors"_a.noconvert(), "out_alphas"_a.noconvert(), nb::arg("lens").none() = nb::none(),
        "Render one view into out_colors (H, W, X) and out_alphas (H, W). Returns a RasterState, or (field, row) of an "
        "input that is not finite.");

  m.def("visible_gaussians", &find_visible, "means"_a.noconvert(), or_none("quats"), or_none("scales"),
        or_none("covars"), "opacities"_a.noconvert(), "viewmat"_a.noconvert(), "K"_a.noconvert(), "width"_a,
        "height"_a, "near_plane"_a, "far_plane"_a, "radius_clip"_a, "eps2d"_a, "antialiased"_a,
        nb::arg("lens").none() = nb::none(),
        "Indices (V,) of the Gaussians that a view may see, or (field, row) of an input that is not finite.");

  m.def("rasterize_backward", &backward, "state"_a, "means"_a.noconvert(), or_none("quats"), or_none("scales"),
        or_none("covars"), "opacities"_a.noconvert(), "colors"_a.noconvert(), "sh_degree"_a, or_none("background"),
        or_none("grad_render"), or_none("grad_alphas"), or_none("grad_means"), or_none("grad_quats"),
        or_none("grad_scales"), or_none("grad_covars"), or_none("grad_opacities"), or_none("grad_colors"),
        or_none("grad_camera"), or_none("grad_background"), or_none("grad_means2d"), or_none("absolute_means2d"),
        "accumulate"_a,
        "Write (or add) the gradients whose arrays are given.");

  m.attr("CAMERA_SUMS") = splatbot::kCameraSums;
  m.def("isa", [] { return std::string(splatbot::isa()); }, "The kernels in use: v2, v3, v4 or baseline.");
  m.def("available_isas", &splatbot::available_isas, "The kernels this CPU can run, the simplest first.");
  m.def("set_isa", [](const std::string& name) { splatbot::set_isa(name); }, "name"_a,
        "Use other kernels; an empty name returns to the default.");
  m.def("num_threads", [] { return splatbot::thread_pool()->size(); }, "Threads that the kernels run on.");
  m.def("keep_to_this_thread", &splatbot::keep_to_this_thread, "alone"_a,
        "Whether loops started by the calling thread use no other: leaves the cores to somebody else.");
  m.def("set_num_threads", &splatbot::set_num_threads, "threads"_a, "Change that number; 0 returns to the default.");
}
