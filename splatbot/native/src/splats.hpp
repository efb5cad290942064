// SPDX-License-Identifier: Apache-2.0
// Steps that renders of Gaussians and of surfels share outside the kernels.
#pragma once

#include <algorithm>
#include <memory>
#include <optional>
#include <span>

#include "checks.hpp"
#include "pull_back.hpp"
#include "splatbot/kernels.hpp"
#include "splatbot/stopwatch.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {

inline std::size_t pixels_of(const View& view) {
  return static_cast<std::size_t>(view.width) * static_cast<std::size_t>(view.height);
}

// Makes room for N splats and for the planes of their pixels.
template <class State, class Options>
void prepare_splats(State& state, const Gaussians& g, const View& view, const Options& options, std::size_t planes) {
  state.count = g.count;
  state.channels = g.channels;
  state.view = view;
  state.options = options;
  state.TileLists::resize(g.count, view);
  state.records.resize(g.count);
  state.final_state.resize(planes * state.tiles() * kTilePixels);
}

// Columns of the rendered image: the colours and a requested depth.
template <class State>
std::size_t columns_of(const State& state) {
  return static_cast<std::size_t>(state.channels) + (state.options.depth != DepthMode::none ? 1U : 0U);
}

template <class Args, class State>
void set_project_args(Args& args, State& state, const Gaussians& g) {
  args.count = state.count;
  args.means = g.means.data();
  args.quats = g.quats.data();
  args.scales = g.scales.data();
  args.covars = pointer(g.covars);
  args.opacities = g.opacities.data();
  args.colors = g.colors.data();
  args.channels = state.channels;
  args.sh_degree = g.sh_degree;
  args.coefficients = g.coefficients;
  args.view = state.view;
  args.options = state.options;
  args.columns = state.columns;
  args.rows = state.rows;
  args.records = state.records.data();
  args.placements = state.placements.data();
  args.visible = state.visible.data();
}

// The parts of a blend's arguments that any walk over the tile lists needs.
template <class Args, class State>
void set_list_args(Args& args, State& state) {
  args.view = state.view;
  args.columns = state.columns;
  args.records = state.records.data();
  args.tile_begin = state.tile_begin.data();
  args.pairs = state.pairs.data();
  args.masks = state.masks.data();
  args.tile_done = state.tile_done.data();
}

// The same of a render of Gaussians, which may leave pixels out.
inline BlendArgs list_args(RasterState& state) {
  BlendArgs args{};
  set_list_args(args, state);
  args.mask = state.mask.size() == 0 ? nullptr : state.mask.data();
  args.mask_size = state.mask_size;
  args.mask_columns = state.mask_columns;
  return args;
}

// Harmonics write their colours from this channel of the records on.
template <class State>
HarmonicsArgs harmonics_args(State& state, const Gaussians& g, int first_channel) {
  return {.count = state.count,
          .means = g.means.data(),
          .coefficients = g.colors.data(),
          .degree = g.sh_degree,
          .held = g.coefficients,
          .view = state.view,
          .visible = state.visible.data(),
          .blocks = state.blocks.data(),
          .colors = state.count == 0 ? nullptr : state.records[0].channels + first_channel,
          .color_stride = sizeof(state.records[0]) / sizeof(float)};
}

template <class State, class Args>
std::optional<Fault> project_splats(State& state, const Args& args,
                                    void (*project)(const Args&, std::size_t block, ProjectedBlock& out)) {
  thread_pool()->run(state.blocks.size(), [&](std::size_t b) { project(args, b, state.blocks[b]); });
  return find_fault(state.blocks);
}

// After projection: colours from harmonics, the order by depth and the tile lists.
template <class State>
void list_splats(State& state, const Gaussians& g, int first_channel, Stopwatch& watch) {
  const std::shared_ptr<ThreadPool> pool = thread_pool();
  if (g.sh_degree >= 0) {
    const Kernels& k = kernels();
    const HarmonicsArgs colors = harmonics_args(state, g, first_channel);
    pool->run(state.blocks.size(), [&](std::size_t b) { k.harmonics(colors, b); });
  }
  order_by_depth(state, *pool);
  state.times.order = watch.lap();
  list_tiles(state, *pool);
  state.times.list_tiles = watch.lap();
}

// Room of a backward pass, kept for the next one on the same thread.
struct BackwardScratch {
  Buffer<float> slots;    // sums of the pairs
  Buffer<float> carried;  // sums of earlier passes
  Buffer<float> colors;   // (N, 3), with harmonics
  Buffer<double> camera;  // (blocks, kCameraSums)
  Buffer<double> center;  // (blocks, 3), with harmonics
};

// Begins a backward pass: zeros sums that are not accumulated, adds the background's gradient, makes room.
template <class State>
BackwardScratch& begin_backward(const State& state, const Gaussians& g, int planes, std::size_t slot,
                                std::span<const float> grad_colors, const Gradients& out) {
  static thread_local BackwardScratch scratch;
  if (!out.accumulate) {
    std::fill(out.camera.begin(), out.camera.end(), 0.0);
    std::fill(out.background.begin(), out.background.end(), 0.0);
  }
  if (!out.background.empty() && !grad_colors.empty()) {
    add_background_gradient(state, state.view, state.final_state.data(), planes, grad_colors, out.background);
  }
  scratch.slots.resize(state.pairs.size() * slot);
  scratch.camera.resize(out.camera.empty() ? 0 : state.blocks.size() * kCameraSums);
  scratch.colors.resize(wants_harmonics(g, out) ? 3 * g.count : 0);
  return scratch;
}

template <class Args, class State>
void set_project_backward_args(Args& args, const State& state, const Gaussians& g, BackwardScratch& scratch,
                               const Gradients& out) {
  args.blocks = state.blocks.data();
  args.slots = scratch.slots.data();
  args.accumulate = out.accumulate;
  args.accumulate_colors = out.accumulate && g.sh_degree < 0;
  args.means = pointer(out.means);
  args.quats = pointer(out.quats);
  args.scales = pointer(out.scales);
  args.opacities = pointer(out.opacities);
  args.colors = wants_harmonics(g, out) ? scratch.colors.data() : pointer(out.colors);
  args.means2d = pointer(out.means2d);
  args.camera = out.camera.empty() ? nullptr : scratch.camera.data();
}

// Ends a backward pass with the gradients through harmonics and to the camera.
template <class State>
void finish_backward(State& state, const Gaussians& g, int first_channel, BackwardScratch& scratch,
                     const Gradients& out) {
  CameraGradient camera;
  camera.add_sums(scratch.camera.span());
  if (wants_harmonics(g, out)) {
    pull_back_harmonics(harmonics_args(state, g, first_channel), state.blocks.size(), scratch.colors.data(), out,
                        scratch.center, camera);
  }
  if (!out.camera.empty()) {
    add_camera_gradient(state.view, camera, out.camera);
  }
}

template <class State>
TileInfo tile_info_of(const State& state, std::size_t bytes) {
  return {kTileWidth, kTileHeight, state.columns, state.rows, state.pairs.size(), bytes};
}

}  // namespace splatbot
