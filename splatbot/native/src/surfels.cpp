// SPDX-License-Identifier: Apache-2.0
#include "splatbot/surfels.hpp"

#include <algorithm>
#include <cmath>

#include "splats.hpp"
#include "state_store.hpp"

namespace splatbot {

struct SurfelState : SplatState<SurfelRecord, SurfelOptions> {};  // planes: kSurfelPlanes

namespace {

void check_surfels(const Gaussians& g) {
  check_gaussians(g);
  require(g.channels <= kMaxSurfelChannels, "a surfel has at most 8 channels");
  require(g.covars.empty(), "a surfel has no covariance");
}

void check_images(const SurfelState& state, const SurfelImages& out) {
  const std::size_t pixels = pixels_of(state.view);
  require(out.colors.size() == pixels * columns_of(state), "colors has a wrong size");
  require(out.alphas.size() == pixels, "alphas has a wrong size");
  require(out.normals.size() == 3 * pixels, "normals has a wrong size");
  require(out.median.size() == pixels, "median has a wrong size");
  require(out.distortion.size() == (state.options.distortion ? pixels : 0), "distortion has a wrong size");
}

void check_gradients(const SurfelState& state, const Gaussians& g, const SurfelImageGradients& grads,
                     const Gradients& out) {
  const std::size_t pixels = pixels_of(state.view), n = state.count;
  const auto channels = static_cast<std::size_t>(state.channels);
  require(empty_or(grads.colors, pixels * columns_of(state)) && empty_or(grads.alphas, pixels) &&
              empty_or(grads.normals, 3 * pixels) && empty_or(grads.median, pixels) &&
              empty_or(grads.distortion, state.options.distortion ? pixels : 0),
          "a gradient of an image has a wrong size");
  require(empty_or(out.means, 3 * n) && empty_or(out.quats, 4 * n) && empty_or(out.scales, 3 * n) &&
              empty_or(out.opacities, n) && empty_or(out.colors, g.colors.size()) && empty_or(out.means2d, 2 * n) &&
              empty_or(out.camera, std::size_t{kCameraSums}) && empty_or(out.background, channels),
          "a gradient has a wrong size");
  require(out.covars.empty() && out.absolute2d.empty(), "surfels have no such gradient");
}

SurfelProjectArgs project_args(SurfelState& state, const Gaussians& g) {
  SurfelProjectArgs args{};
  set_project_args(args, state, g);
  return args;
}

SurfelBlendArgs blend_args(SurfelState& state, std::span<const float> background) {
  SurfelBlendArgs args{};
  set_list_args(args, state);
  args.options = state.options;
  args.channels = state.channels;
  args.final_state = state.final_state.data();
  args.background = pointer(background);
  return args;
}

}  // namespace

std::optional<Fault> surfels_forward(const Gaussians& g, const View& view, const SurfelOptions& options,
                                     std::span<const float> background, const SurfelImages& out,
                                     SurfelStatePtr& result) {
  check_surfels(g);
  check_view(view);
  const SurfelStatePtr shared = new_state<SurfelState>();
  SurfelState& state = *shared;
  prepare_splats(state, g, view, options, kSurfelPlanes);
  require(empty_or(background, static_cast<std::size_t>(g.channels)), "background is not (channels,)");
  check_images(state, out);

  const Kernels& k = kernels();
  Stopwatch watch;
  if (const std::optional<Fault> fault = project_splats(state, project_args(state, g), k.surfels.project)) {
    return fault;
  }
  state.times = {.project = watch.lap()};
  list_splats(state, g, 0, watch);
  SurfelBlendArgs blend = blend_args(state, background);
  blend.colors = out.colors.data();
  blend.alphas = out.alphas.data();
  blend.normals = out.normals.data();
  blend.median = out.median.data();
  blend.distortion = pointer(out.distortion);
  thread_pool()->run(state.tiles(), [&](std::size_t tile) { k.surfels.blend(blend, tile); });
  result = shared;
  return std::nullopt;
}

void surfels_backward(const SurfelState& const_state, const Gaussians& g, std::span<const float> background,
                      const SurfelImageGradients& grads, const Gradients& out) {
  check_surfels(g);
  // Kernel arguments hold plain pointers for both passes; this one writes to none of the state's arrays.
  auto& state = const_cast<SurfelState&>(const_state);
  require(g.count == state.count && g.channels == state.channels, "the surfels are not those of the forward pass");
  check_gradients(state, g, grads, out);
  BackwardScratch& s = begin_backward(state, g, kSurfelPlanes, kSurfelSlot, grads.colors, out);
  if (out.means.empty() && out.quats.empty() && out.scales.empty() && out.opacities.empty() && out.camera.empty() &&
      out.colors.empty() && out.means2d.empty()) {
    return;
  }

  const Kernels& k = kernels();
  const std::shared_ptr<ThreadPool> pool = thread_pool();
  const bool sum_channels = !out.colors.empty() || !out.quats.empty() || wants_harmonics(g, out);
  const SurfelBlendBackwardArgs blend = {.forward = blend_args(state, background),
                                         .colors = pointer(grads.colors),
                                         .alphas = pointer(grads.alphas),
                                         .normals = pointer(grads.normals),
                                         .median = pointer(grads.median),
                                         .distortion = pointer(grads.distortion),
                                         .sum_channels = sum_channels,
                                         .slots = s.slots.data()};
  pool->run(state.tiles(), [&](std::size_t tile) { k.surfels.blend_backward(blend, tile); });
  SurfelProjectBackwardArgs project{};
  project.forward = project_args(state, g);
  set_project_backward_args(project, state, g, s, out);
  project.sum_channels = sum_channels;
  pool->run(state.blocks.size(), [&](std::size_t b) { k.surfels.project_backward(project, b); });
  finish_backward(state, g, 0, s, out);
}

void describe_surfels(const SurfelState& state, const SurfelProjections& out) {
  const std::size_t n = state.count;
  require(out.means2d.size() == 2 * n && out.depths.size() == n && out.normals.size() == 3 * n &&
              out.radii.size() == 2 * n && out.tiles_touched.size() == n,
          "an output has a wrong size");
  static constexpr SurfelRecord kNothing{};
  for (std::size_t i = 0; i < n; ++i) {
    const Placement& place = state.placements[i];
    const bool visible = place.nx != 0;
    const SurfelRecord& r = visible ? state.records[i] : kNothing;
    const float mx = r.mx + r.part_x, my = r.my + r.part_y;
    out.means2d[2 * i] = mx;
    out.means2d[2 * i + 1] = my;
    out.depths[i] = r.z;
    std::copy_n(r.normal, 3, &out.normals[3 * i]);
    const auto radius = [&](float offset, double extent) {
      const double reach = std::max(static_cast<double>(r.circle), std::abs(static_cast<double>(offset)) + extent);
      return static_cast<std::int32_t>(std::ceil(!visible ? 0.0 : r.l11 > 0.0F ? std::min(1e9, reach) : 1e9));
    };
    out.radii[2 * i] = radius(r.ex - mx, std::hypot(r.l21, r.l22) / (static_cast<double>(r.l11) * r.l22));
    out.radii[2 * i + 1] = radius(r.ey - my, 1.0 / r.l22);
    out.tiles_touched[i] = std::int32_t{place.nx} * std::int32_t{place.ny};
  }
}

std::size_t surfel_count(const SurfelState& state) { return state.count; }

std::span<const std::uint32_t> visible_ids(const SurfelState& state) { return state.ids.span(); }

TileInfo tile_info(const SurfelState& state) {
  return tile_info_of(state,
                      state.TileLists::bytes() + state.records.capacity_bytes() + state.final_state.capacity_bytes());
}

}  // namespace splatbot
