// SPDX-License-Identifier: Apache-2.0
#include "splatbot/rasterizer.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <stdexcept>
#include <string>

#include "splats.hpp"
#include "state_store.hpp"

namespace splatbot {

namespace {

// Up to eight channels are blended at a time, depth with the first; plane depth needs room for its two slopes.
std::vector<ChannelPass> plan_passes(int channels, const RasterOptions& options) {
  std::vector<ChannelPass> passes;
  int next = 0;
  bool depth = options.depth != DepthMode::none;
  while (depth || next < channels) {
    ChannelPass pass;
    const int room = depth && options.plane_depth ? kRecordChannels - 2 : kRecordChannels;
    pass.depth_first = depth;
    pass.first_color = next;
    if (depth) {
      pass.column[static_cast<std::size_t>(pass.count++)] = channels;
      depth = false;
    }
    while (pass.count < room && next < channels) {
      pass.column[static_cast<std::size_t>(pass.count++)] = next++;
    }
    passes.push_back(pass);
  }
  return passes;
}

ProjectArgs project_args(RasterState& state, const Gaussians& g) {
  ProjectArgs args{};
  set_project_args(args, state, g);
  args.passes = state.passes.data();
  args.n_passes = static_cast<int>(state.passes.size());
  args.more_channels = state.more_channels.data();
  return args;
}

BlendArgs blend_args(RasterState& state, std::size_t p, const float* background) {
  const std::size_t plane = state.tiles() * kFinalPlanes * kTilePixels;
  const bool first = p == 0;
  BlendArgs args = list_args(state);
  args.pass = &state.passes[p];
  args.depth = state.options.depth;
  args.plane_depth = state.options.plane_depth;
  args.write_alphas = first;
  args.transmittance_min = state.options.transmittance_min;
  args.channels = first ? (state.count == 0 ? nullptr : state.records[0].channels)
                        : state.more_channels.data() + (p - 1) * state.count * kRecordChannels;
  args.channel_stride = first ? sizeof(Record) / sizeof(float) : kRecordChannels;
  args.final_state = state.final_state.data() + p * plane;
  args.background = background;
  args.out_channels = state.out_channels;
  return args;
}

// The background of a pass's channels, 0 behind depth.
std::array<float, kRecordChannels> background_of(const ChannelPass& pass, std::span<const float> background) {
  std::array<float, kRecordChannels> values{};
  const int depth = pass.depth_first ? 1 : 0;
  for (int c = depth; c < pass.count && !background.empty(); ++c) {
    values[static_cast<std::size_t>(c)] = background[static_cast<std::size_t>(pass.first_color + c - depth)];
  }
  return values;
}

void prepare(RasterState& state, const Gaussians& g, const View& view, const RasterOptions& options) {
  state.passes = plan_passes(g.channels, options);
  require(!state.passes.empty(), "nothing to render: no colours and no depth");
  prepare_splats(state, g, view, options, state.passes.size() * kFinalPlanes);
  state.out_channels = static_cast<int>(columns_of(state));
  state.more_channels.resize((state.passes.size() - 1) * g.count * kRecordChannels);
}

void keep_mask(RasterState& state, const TileMask& mask) {
  state.mask.resize(mask.keep.size());
  std::copy(mask.keep.begin(), mask.keep.end(), state.mask.data());
  state.mask_size = mask.size;
  state.mask_columns = mask.keep.empty() ? 0 : (state.view.width + mask.size - 1) / mask.size;
  if (!mask.keep.empty()) {
    require(mask.size > 0, "a mask's tiles have no pixels");
    const auto rows = static_cast<std::size_t>((state.view.height + mask.size - 1) / mask.size);
    require(mask.keep.size() == rows * static_cast<std::size_t>(state.mask_columns), "the mask has a wrong size");
  }
}

// The record's channel where colours begin.
int first_color(const RasterState& state) { return state.options.depth != DepthMode::none ? 1 : 0; }

// How many of a pass's channels need their gradients summed.
int channel_sums(const ChannelPass& pass, const Gradients& out) {
  if (!out.colors.empty()) {
    return pass.count;
  }
  const bool position = !out.means.empty() || !out.camera.empty() || !out.means2d.empty();
  return pass.depth_first && position ? 1 : 0;
}

void describe_one(const RasterState& state, std::size_t i, const Projections& out) {
  constexpr double kRootHalfLog2e = 0.84932180028801904;  // d of Record in standard deviations
  const Placement& place = state.placements[i];
  const bool visible = place.nx != 0;
  const Record& r = state.records[i];
  const double l11 = visible ? r.l11 / kRootHalfLog2e : 0.0;
  const double l21 = visible ? r.l21 / kRootHalfLog2e : 0.0;
  const double l22 = visible ? r.l22 / kRootHalfLog2e : 0.0;
  const double lo = visible ? r.lo : kLog2AlphaMin;
  out.means2d[2 * i] = visible ? r.mx : 0.0F;
  out.means2d[2 * i + 1] = visible ? r.my : 0.0F;
  out.depths[i] = std::bit_cast<float>(visible ? place.depth_bits : 0U);
  out.conics[3 * i] = static_cast<float>(l11 * l11);
  out.conics[3 * i + 1] = static_cast<float>(l11 * l21);
  out.conics[3 * i + 2] = static_cast<float>(l21 * l21 + l22 * l22);
  out.opacities[i] = visible ? static_cast<float>(std::exp2(lo)) : 0.0F;
  const double sigmas =
      std::min(static_cast<double>(kMaxSigmas), std::sqrt(2.0 * std::log(2.0) * std::max(lo - kLog2AlphaMin, 0.0)));
  const double sx = visible ? std::sqrt(l21 * l21 + l22 * l22) / (l11 * l22) : 0.0;
  const double sy = visible ? 1.0 / l22 : 0.0;
  out.radii[2 * i] = static_cast<std::int32_t>(std::min(1e9, std::ceil(sigmas * sx)));
  out.radii[2 * i + 1] = static_cast<std::int32_t>(std::min(1e9, std::ceil(sigmas * sy)));
}

}  // namespace

std::size_t RasterState::bytes() const noexcept {
  return TileLists::bytes() + records.capacity_bytes() + more_channels.capacity_bytes() +
         final_state.capacity_bytes() + mask.capacity_bytes();
}

std::optional<Fault> rasterize_forward(const Gaussians& g, const View& view, const RasterOptions& options,
                                       std::span<const float> background, const TileMask& mask,
                                       std::span<float> out_colors, std::span<float> out_alphas,
                                       RasterStatePtr& result) {
  check_gaussians(g);
  check_view(view);
  const std::size_t pixels = pixels_of(view);
  const RasterStatePtr shared = new_state<RasterState>();
  RasterState& state = *shared;
  prepare(state, g, view, options);
  require(empty_or(background, static_cast<std::size_t>(g.channels)), "background is not (channels,)");
  require(out_colors.size() == pixels * static_cast<std::size_t>(state.out_channels), "out_colors has a wrong size");
  require(out_alphas.size() == pixels, "out_alphas has a wrong size");
  keep_mask(state, mask);

  const Kernels& k = kernels();
  const std::shared_ptr<ThreadPool> pool = thread_pool();
  Stopwatch watch;
  const std::optional<Fault> fault = project_splats(state, project_args(state, g), k.gaussians.project);
  state.times = {.project = watch.lap()};
  if (fault) {
    return fault;
  }
  list_splats(state, g, first_color(state), watch);
  for (std::size_t p = 0; p < state.passes.size(); ++p) {
    const auto behind = background_of(state.passes[p], background);
    BlendArgs blend = blend_args(state, p, background.empty() ? nullptr : behind.data());
    blend.out_colors = out_colors.data();
    blend.out_alphas = out_alphas.data();
    pool->run(state.tiles(), [&](std::size_t tile) { k.gaussians.blend(blend, tile); });
  }
  state.times.blend = watch.lap();
  result = shared;
  return std::nullopt;
}

std::optional<Fault> find_visible(const Gaussians& g, const View& view, const RasterOptions& options,
                                  std::vector<std::uint32_t>& ids) {
  check_gaussians(g);
  check_view(view);
  const RasterStatePtr shared = new_state<RasterState>();
  RasterState& state = *shared;
  RasterOptions depth_alone = options;
  depth_alone.depth = DepthMode::accumulated;
  prepare(state, g, view, depth_alone);
  if (const std::optional<Fault> fault = project_splats(state, project_args(state, g), kernels().gaussians.project)) {
    return fault;
  }
  for (std::size_t b = 0; b < state.blocks.size(); ++b) {
    const std::uint32_t* found = state.visible.data() + b * kProjectBlock;
    ids.insert(ids.end(), found, found + state.blocks[b].visible);
  }
  return std::nullopt;
}

void rasterize_backward(const RasterState& const_state, const Gaussians& g, std::span<const float> background,
                        std::span<const float> grad_colors, std::span<const float> grad_alphas, const Gradients& out) {
  check_gaussians(g);
  // Kernel arguments hold plain pointers for both passes; this one writes to none of the state's arrays.
  auto& state = const_cast<RasterState&>(const_state);
  const std::size_t pixels = pixels_of(state.view);
  require(g.count == state.count && g.channels == state.channels, "the Gaussians are not those of the forward pass");
  require(empty_or(grad_colors, pixels * static_cast<std::size_t>(state.out_channels)), "grad_colors has a wrong size");
  require(empty_or(grad_alphas, pixels), "grad_alphas has a wrong size");
  require(empty_or(background, static_cast<std::size_t>(g.channels)), "background is not (channels,)");
  require(empty_or(out.means, 3 * g.count) && empty_or(out.quats, g.quats.size()) &&
              empty_or(out.scales, g.scales.size()) && empty_or(out.covars, g.covars.size()) &&
              empty_or(out.opacities, g.count) && empty_or(out.colors, g.colors.size()) &&
              empty_or(out.camera, std::size_t{kCameraSums}) && empty_or(out.means2d, 2 * g.count) &&
              empty_or(out.absolute2d, 2 * g.count) &&
              empty_or(out.background, static_cast<std::size_t>(g.channels)),
          "a gradient has a wrong size");

  const Kernels& k = kernels();
  const std::shared_ptr<ThreadPool> pool = thread_pool();
  BackwardScratch& s = begin_backward(state, g, kFinalPlanes, kSlot, grad_colors, out);
  const bool geometry = !(out.means.empty() && out.quats.empty() && out.scales.empty() && out.covars.empty() &&
                          out.opacities.empty() && out.camera.empty() && out.means2d.empty() &&
                          out.absolute2d.empty());
  if (!geometry && out.colors.empty()) {
    return;
  }
  const bool harmonics_wanted = wants_harmonics(g, out);

  const std::size_t passes = state.passes.size();
  s.carried.resize(passes > 1 ? g.count * kSlot : 0);
  for (std::size_t p = 0; p < passes; ++p) {
    const auto behind = background_of(state.passes[p], background);
    const int sums = harmonics_wanted ? state.passes[p].count : channel_sums(state.passes[p], out);
    const BlendBackwardArgs blend = {.forward = blend_args(state, p, background.empty() ? nullptr : behind.data()),
                                     .grad_colors = grad_colors.empty() ? nullptr : grad_colors.data(),
                                     .grad_alphas = grad_alphas.empty() || p > 0 ? nullptr : grad_alphas.data(),
                                     .channel_sums = sums,
                                     .geometry = geometry,
                                     .absolute = !out.absolute2d.empty(),
                                     .slots = s.slots.data()};
    Stopwatch watch;
    pool->run(state.tiles(), [&](std::size_t tile) { k.gaussians.blend_backward(blend, tile); });
    state.times.blend_backward = (p == 0 ? 0.0 : state.times.blend_backward) + watch.lap();
    ProjectBackwardArgs project{};
    project.forward = project_args(state, g);
    set_project_backward_args(project, state, g, s, out);
    project.pass = &state.passes[p];
    project.channel_sums = sums;
    project.depth_in_pass = state.passes[p].depth_first;
    project.carried = passes > 1 ? s.carried.data() : nullptr;
    project.first = p == 0;
    project.last = p + 1 == passes;
    project.geometry = geometry;
    project.covars = pointer(out.covars);
    project.absolute2d = pointer(out.absolute2d);
    pool->run(state.blocks.size(), [&](std::size_t b) { k.gaussians.project_backward(project, b); });
    state.times.project_backward = (p == 0 ? 0.0 : state.times.project_backward) + watch.lap();
  }
  finish_backward(state, g, first_color(state), s, out);
}

void describe_projections(const RasterState& state, const Projections& out) {
  require(out.means2d.size() == 2 * state.count && out.depths.size() == state.count &&
              out.conics.size() == 3 * state.count && out.radii.size() == 2 * state.count &&
              out.opacities.size() == state.count,
          "an output has a wrong size");
  thread_pool()->run(state.blocks.size(), [&](std::size_t b) {
    const std::size_t end = std::min(state.count, (b + 1) * kProjectBlock);
    for (std::size_t i = b * kProjectBlock; i < end; ++i) {
      describe_one(state, i, out);
    }
  });
}

void count_contributions(const RasterState& const_state, std::span<std::int32_t> out) {
  require(out.size() == const_state.count, "the output is not (N,)");
  auto& state = const_cast<RasterState&>(const_state);  // as in rasterize_backward()
  const Kernels& k = kernels();
  const std::shared_ptr<ThreadPool> pool = thread_pool();
  std::vector<std::uint32_t> counts(state.pairs.size());
  const ContributionArgs args = {.forward = blend_args(state, 0, nullptr), .counts = counts.data()};
  pool->run(state.tiles(), [&](std::size_t tile) { k.contributions(args, tile); });
  for (std::size_t i = 0; i < state.count; ++i) {
    const Placement& place = state.placements[i];
    const std::size_t pairs = std::size_t{place.nx} * place.ny;
    const std::size_t first = state.blocks[i / kProjectBlock].first_pair + place.slot;
    out[i] = 0;
    for (std::size_t p = 0; p < pairs; ++p) {
      out[i] += static_cast<std::int32_t>(counts[first + p]);
    }
  }
}

std::size_t gaussian_count(const RasterState& state) { return state.count; }

std::span<const std::uint32_t> visible_ids(const RasterState& state) { return state.ids.span(); }

TileInfo tile_info(const RasterState& state) {
  return tile_info_of(state, state.bytes());
}

}  // namespace splatbot
