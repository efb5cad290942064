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
struct SurfelHandle {
  splatbot::SurfelStatePtr state;
};

splatbot::Gaussians surfels_of(const InN3& means, const InN4& quats, const InN3& scales, const In1& opacities,
                               const In2& colors) {
  return {.count = means.shape(0),
          .channels = static_cast<int>(colors.shape(1)),
          .means = span_of(means),
          .quats = span_of(quats),
          .scales = span_of(scales),
          .covars = {},
          .opacities = span_of(opacities),
          .colors = span_of(colors)};
}

nb::object forward(const InN3& means, const InN4& quats, const InN3& scales, const In1& opacities, const In2& colors,
                   const Matrix4& viewmat, const Matrix3& K, int width, int height, float near_plane, float far_plane,
                   float radius_clip, const std::string& depth, const std::optional<In1>& background,
                   const Out3& out_colors, const Out2& out_alphas, const Out3& out_normals, const Out2& out_median,
                   const std::optional<Out2>& out_distortion) {
  const splatbot::Gaussians surfels = surfels_of(means, quats, scales, opacities, colors);
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
  SurfelHandle state;
  std::optional<splatbot::Fault> fault;
  {
    const nb::gil_scoped_release release;
    fault = splatbot::surfels_forward(surfels, view, options, span_of<const float>(background), out, state.state);
  }
  if (fault) {
    return nb::make_tuple(nb::str(fault->field.data(), fault->field.size()), fault->row);
  }
  return nb::cast(std::move(state));
}

void backward(const SurfelHandle& state, const InN3& means, const InN4& quats, const InN3& scales, const In1& opacities,
              const In2& colors, const std::optional<In1>& background, const std::optional<In3>& grad_colors,
              const std::optional<In2>& grad_alphas, const std::optional<In3>& grad_normals,
              const std::optional<In2>& grad_median, const std::optional<In2>& grad_distortion,
              const std::optional<Out2>& out_means, const std::optional<Out2>& out_quats,
              const std::optional<Out2>& out_scales, const std::optional<Array<float, nb::shape<-1>>>& out_opacities,
              const std::optional<Out2>& out_colors, const std::optional<Array<double, nb::shape<16>>>& out_camera,
              const std::optional<Array<double, nb::shape<-1>>>& out_background,
              const std::optional<Out2>& out_means2d, bool accumulate) {
  const splatbot::Gaussians surfels = surfels_of(means, quats, scales, opacities, colors);
  const splatbot::SurfelImageGradients grads = {.colors = span_of<const float>(grad_colors),
                                                .alphas = span_of<const float>(grad_alphas),
                                                .normals = span_of<const float>(grad_normals),
                                                .median = span_of<const float>(grad_median),
                                                .distortion = span_of<const float>(grad_distortion)};
  splatbot::Gradients out;
  out.means = span_of<float>(out_means);
  out.quats = span_of<float>(out_quats);
  out.scales = span_of<float>(out_scales);
  out.opacities = span_of<float>(out_opacities);
  out.colors = span_of<float>(out_colors);
  out.camera = span_of<double>(out_camera);
  out.background = span_of<double>(out_background);
  out.means2d = span_of<float>(out_means2d);
  out.accumulate = accumulate;
  const nb::gil_scoped_release release;
  splatbot::surfels_backward(*state.state, surfels, span_of<const float>(background), grads, out);
}

nb::dict describe(const SurfelHandle& state, const In1& opacities) {
  const std::size_t n = opacities.size();
  std::vector<float> means2d(2 * n), depths(n), normals(3 * n);
  std::vector<std::int32_t> radii(2 * n), tiles(n);
  {
    const nb::gil_scoped_release release;
    splatbot::describe_surfels(*state.state, {means2d, depths, normals, radii, tiles});
  }
  nb::dict d;
  d["means2d"] = owned(std::move(means2d), {n, 2});
  d["depths"] = owned(std::move(depths), {n});
  d["normals"] = owned(std::move(normals), {n, 3});
  d["radii"] = owned(std::move(radii), {n, 2});
  d["tiles_per_gauss"] = owned(std::move(tiles), {n});
  return d;
}

nb::ndarray<nb::numpy, std::int64_t> visible(const SurfelHandle& state) {
  const auto ids = splatbot::visible_ids(*state.state);
  return owned(std::vector<std::int64_t>(ids.begin(), ids.end()), {ids.size()});
}

nb::dict tiles(const SurfelHandle& state) {
  const splatbot::TileInfo info = splatbot::tile_info(*state.state);
  nb::dict d;
  d["tile_size"] = nb::make_tuple(info.tile_width, info.tile_height);
  d["tile_width"] = info.columns;
  d["tile_height"] = info.rows;
  d["n_isects"] = info.pairs;
  d["state_bytes"] = info.state_bytes;
  return d;
}

}  // namespace

void define_surfels(nb::module_& m) {
  nb::class_<SurfelHandle>(m, "SurfelState", "What a render of surfels leaves for its backward pass.")
      .def("describe", &describe, "opacities"_a.noconvert(), "Projections as a dict of arrays.")
      .def("visible", &visible, "Indices (V,) of the surfels in view.")
      .def("tiles", &tiles, "Tile grid, pairs and bytes held.");

  m.attr("MAX_SURFEL_CHANNELS") = splatbot::kMaxSurfelChannels;

  m.def("surfels_forward", &forward, "means"_a.noconvert(), "quats"_a.noconvert(), "scales"_a.noconvert(),
        "opacities"_a.noconvert(), "colors"_a.noconvert(), "viewmat"_a.noconvert(), "K"_a.noconvert(), "width"_a,
        "height"_a, "near_plane"_a, "far_plane"_a, "radius_clip"_a, "depth"_a,
        nb::arg("background").noconvert().none(), "out_colors"_a.noconvert(), "out_alphas"_a.noconvert(),
        "out_normals"_a.noconvert(), "out_median"_a.noconvert(), nb::arg("out_distortion").noconvert().none(),
        "Render one view of surfels. Returns a SurfelState, or (field, row) of an input that is not finite.");

  m.def("surfels_backward", &backward, "state"_a, "means"_a.noconvert(), "quats"_a.noconvert(),
        "scales"_a.noconvert(), "opacities"_a.noconvert(), "colors"_a.noconvert(),
        nb::arg("background").noconvert().none(), nb::arg("grad_colors").noconvert().none(),
        nb::arg("grad_alphas").noconvert().none(), nb::arg("grad_normals").noconvert().none(),
        nb::arg("grad_median").noconvert().none(), nb::arg("grad_distortion").noconvert().none(),
        nb::arg("out_means").noconvert().none(), nb::arg("out_quats").noconvert().none(),
        nb::arg("out_scales").noconvert().none(), nb::arg("out_opacities").noconvert().none(),
        nb::arg("out_colors").noconvert().none(), nb::arg("out_camera").noconvert().none(),
        nb::arg("out_background").noconvert().none(), nb::arg("out_means2d").noconvert().none(), "accumulate"_a,
        "Write (or add) the gradients whose arrays are given; that of means2d is never added to.");
}
