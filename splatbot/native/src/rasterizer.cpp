// SPDX-License-Identifier: Apache-2.0
#include "splatbot/rasterizer.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <mutex>
#include <stdexcept>
#include <string>

#include "splatbot/kernels.hpp"
#include "splatbot/stopwatch.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {

namespace {

// States whose render is done with, kept for the next one: their memory is warm.
class StateStore {
 public:
  std::unique_ptr<RasterState> take() {
    const std::lock_guard lock(mutex_);
    if (idle_.empty()) {
      return std::make_unique<RasterState>();
    }
    std::unique_ptr<RasterState> state = std::move(idle_.back());
    idle_.pop_back();
    return state;
  }

  void give_back(std::unique_ptr<RasterState> state) noexcept {
    constexpr std::size_t kMaxIdle = 2;
    const std::lock_guard lock(mutex_);
    if (idle_.size() < kMaxIdle) {
      idle_.push_back(std::move(state));
    }
  }

  static StateStore& instance() {
    // Never destroyed: states may outlive static objects at the exit of the interpreter.
    static StateStore& store = *std::make_unique<StateStore>().release();
    return store;
  }

  StateStore() { idle_.reserve(2); }

 private:
  std::mutex mutex_;
  std::vector<std::unique_ptr<RasterState>> idle_;
};

RasterStatePtr new_state() {
  return {StateStore::instance().take().release(),
          [](RasterState* state) { StateStore::instance().give_back(std::unique_ptr<RasterState>(state)); }};
}

void require(bool ok, const char* what) {
  if (!ok) {
    throw std::invalid_argument(what);
  }
}

template <class T>
bool empty_or(std::span<T> span, std::size_t size) {
  return span.empty() || span.size() == size;
}

void check_gaussians(const Gaussians& g) {
  require(g.count < (std::size_t{1} << 32) - 1 && g.channels >= 0, "too many Gaussians");
  require(g.means.size() == 3 * g.count, "means is not (N, 3)");
  require(g.quats.size() == 4 * g.count, "quats is not (N, 4)");
  require(g.scales.size() == 3 * g.count, "scales is not (N, 3)");
  require(g.opacities.size() == g.count, "opacities is not (N,)");
  require(g.colors.size() == g.count * static_cast<std::size_t>(g.channels), "colors is not (N, channels)");
}

void check_view(const View& view) {
  constexpr int kMaxTiles = 65535;
  require(view.width > 0 && view.height > 0, "the image has no pixels");
  require(view.width <= kMaxTiles * kTileWidth && view.height <= kMaxTiles * kTileHeight, "the image is too large");
  require(static_cast<std::int64_t>(view.width) * view.height <= (std::int64_t{1} << 31), "the image is too large");
}

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
  return {.count = state.count,
          .means = g.means.data(),
          .quats = g.quats.data(),
          .scales = g.scales.data(),
          .opacities = g.opacities.data(),
          .colors = g.colors.data(),
          .channels = state.channels,
          .view = state.view,
          .options = state.options,
          .columns = state.columns,
          .rows = state.rows,
          .passes = state.passes.data(),
          .n_passes = static_cast<int>(state.passes.size()),
          .records = state.records.data(),
          .placements = state.placements.data(),
          .visible = state.visible.data(),
          .more_channels = state.more_channels.data()};
}

BlendArgs blend_args(RasterState& state, std::size_t p, const float* background) {
  const std::size_t plane = state.tiles() * kFinalPlanes * kTilePixels;
  const bool first = p == 0;
  return {.view = state.view,
          .columns = state.columns,
          .pass = &state.passes[p],
          .depth = state.options.depth,
          .plane_depth = state.options.plane_depth,
          .write_alphas = first,
          .records = state.records.data(),
          .channels = first ? (state.count == 0 ? nullptr : state.records[0].channels)
                            : state.more_channels.data() + (p - 1) * state.count * kRecordChannels,
          .channel_stride = first ? sizeof(Record) / sizeof(float) : kRecordChannels,
          .tile_begin = state.tile_begin.data(),
          .pairs = state.pairs.data(),
          .masks = state.masks.data(),
          .tile_done = state.tile_done.data(),
          .final_state = state.final_state.data() + p * plane,
          .background = background,
          .out_colors = nullptr,
          .out_channels = state.out_channels,
          .out_alphas = nullptr};
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
  state.count = g.count;
  state.channels = g.channels;
  state.view = view;
  state.options = options;
  state.columns = (view.width + kTileWidth - 1) / kTileWidth;
  state.rows = (view.height + kTileHeight - 1) / kTileHeight;
  state.passes = plan_passes(g.channels, options);
  state.out_channels = g.channels + (options.depth != DepthMode::none ? 1 : 0);
  require(!state.passes.empty(), "nothing to render: no colours and no depth");
  state.blocks.resize((g.count + kProjectBlock - 1) / kProjectBlock);
  state.records.resize(g.count);
  state.placements.resize(g.count);
  state.visible.resize(g.count);
  state.more_channels.resize((state.passes.size() - 1) * g.count * kRecordChannels);
  state.tile_done.resize(state.tiles());
  state.final_state.resize(state.passes.size() * state.tiles() * kFinalPlanes * kTilePixels);
}

std::optional<Fault> find_fault(const RasterState& state) {
  static constexpr std::string_view kFields[] = {"means", "quats", "scales", "opacities", "colors"};
  for (const ProjectedBlock& block : state.blocks) {
    if (block.fault_field >= 0) {
      return Fault{kFields[block.fault_field], block.fault_row};
    }
  }
  return std::nullopt;
}

// d render / d background is the transmittance left.
void add_background_gradient(const RasterState& state, std::span<const float> grad_colors, std::span<double> out) {
  const auto width = static_cast<std::size_t>(state.view.width);
  const auto stride = static_cast<std::size_t>(state.out_channels);
  for (std::size_t y = 0; y < static_cast<std::size_t>(state.view.height); ++y) {
    for (std::size_t x = 0; x < width; ++x) {
      const std::size_t tile = y / kTileHeight * static_cast<std::size_t>(state.columns) + x / kTileWidth;
      const std::size_t in_y = y % kTileHeight, in_x = x % kTileWidth;
      const std::size_t i = ((in_y / kBlock) * kBlockColumns + in_x / kBlock) * kBlockPixels + in_y % kBlock * kBlock +
                            in_x % kBlock;
      const double t = static_cast<double>(state.final_state[tile * kFinalPlanes * kTilePixels + i]);
      for (std::size_t c = 0; c < out.size(); ++c) {
        out[c] += t * static_cast<double>(grad_colors[(y * width + x) * stride + c]);
      }
    }
  }
}

// How many of a pass's channels need their gradients summed.
int channel_sums(const ChannelPass& pass, const Gradients& out) {
  if (!out.colors.empty()) {
    return pass.count;
  }
  const bool position = !out.means.empty() || !out.viewmat.empty();
  return pass.depth_first && position ? 1 : 0;
}

struct BackwardScratch {
  Buffer<float> slots, carried;
  Buffer<double> viewmat;
};

BackwardScratch& scratch() {
  static thread_local BackwardScratch instance;
  return instance;
}

}  // namespace

std::size_t RasterState::bytes() const noexcept {
  return records.capacity_bytes() + placements.capacity_bytes() + visible.capacity_bytes() + ids.capacity_bytes() +
         more_channels.capacity_bytes() + order.capacity_bytes() + order_scratch.capacity_bytes() +
         histogram.capacity_bytes() + tile_begin.capacity_bytes() + pairs.capacity_bytes() + masks.capacity_bytes() +
         tile_done.capacity_bytes() + final_state.capacity_bytes();
}

std::optional<Fault> rasterize_forward(const Gaussians& g, const View& view, const RasterOptions& options,
                                       std::span<const float> background, std::span<float> out_colors,
                                       std::span<float> out_alphas, RasterStatePtr& result) {
  check_gaussians(g);
  check_view(view);
  const std::size_t pixels = static_cast<std::size_t>(view.width) * static_cast<std::size_t>(view.height);
  const RasterStatePtr shared = new_state();
  RasterState& state = *shared;
  prepare(state, g, view, options);
  require(empty_or(background, static_cast<std::size_t>(g.channels)), "background is not (channels,)");
  require(out_colors.size() == pixels * static_cast<std::size_t>(state.out_channels), "out_colors has a wrong size");
  require(out_alphas.size() == pixels, "out_alphas has a wrong size");

  const Kernels& k = kernels();
  const std::shared_ptr<ThreadPool> pool = thread_pool();
  Stopwatch watch;
  const ProjectArgs project = project_args(state, g);
  pool->run(state.blocks.size(), [&](std::size_t b) { k.project(project, b, state.blocks[b]); });
  state.times = {.project = watch.lap()};
  if (const std::optional<Fault> fault = find_fault(state)) {
    return fault;
  }
  order_by_depth(state, *pool);
  state.times.order = watch.lap();
  list_tiles(state, *pool);
  state.times.list_tiles = watch.lap();
  for (std::size_t p = 0; p < state.passes.size(); ++p) {
    const auto behind = background_of(state.passes[p], background);
    BlendArgs blend = blend_args(state, p, background.empty() ? nullptr : behind.data());
    blend.out_colors = out_colors.data();
    blend.out_alphas = out_alphas.data();
    pool->run(state.tiles(), [&](std::size_t tile) { k.blend(blend, tile); });
  }
  state.times.blend = watch.lap();
  result = shared;
  return std::nullopt;
}

void rasterize_backward(const RasterState& const_state, const Gaussians& g, std::span<const float> background,
                        std::span<const float> grad_colors, std::span<const float> grad_alphas, const Gradients& out) {
  check_gaussians(g);
  // Kernel arguments hold plain pointers for both passes; this one writes to none of the state's arrays.
  auto& state = const_cast<RasterState&>(const_state);
  const std::size_t pixels =
      static_cast<std::size_t>(state.view.width) * static_cast<std::size_t>(state.view.height);
  require(g.count == state.count && g.channels == state.channels, "the Gaussians are not those of the forward pass");
  require(empty_or(grad_colors, pixels * static_cast<std::size_t>(state.out_channels)), "grad_colors has a wrong size");
  require(empty_or(grad_alphas, pixels), "grad_alphas has a wrong size");
  require(empty_or(background, static_cast<std::size_t>(g.channels)), "background is not (channels,)");
  require(empty_or(out.means, 3 * g.count) && empty_or(out.quats, 4 * g.count) && empty_or(out.scales, 3 * g.count) &&
              empty_or(out.opacities, g.count) && empty_or(out.colors, g.colors.size()) &&
              empty_or(out.viewmat, std::size_t{12}) &&
              empty_or(out.background, static_cast<std::size_t>(g.channels)),
          "a gradient has a wrong size");

  const Kernels& k = kernels();
  const std::shared_ptr<ThreadPool> pool = thread_pool();
  if (!out.accumulate) {
    std::fill(out.viewmat.begin(), out.viewmat.end(), 0.0);
    std::fill(out.background.begin(), out.background.end(), 0.0);
  }
  if (!out.background.empty() && !grad_colors.empty()) {
    add_background_gradient(state, grad_colors, out.background);
  }
  const bool geometry =
      !(out.means.empty() && out.quats.empty() && out.scales.empty() && out.opacities.empty() && out.viewmat.empty());
  if (!geometry && out.colors.empty()) {
    return;
  }

  BackwardScratch& s = scratch();
  const std::size_t passes = state.passes.size();
  s.slots.resize(state.pairs.size() * kSlot);
  s.carried.resize(passes > 1 ? g.count * kSlot : 0);
  s.viewmat.resize(out.viewmat.empty() ? 0 : state.blocks.size() * 12);
  for (std::size_t p = 0; p < passes; ++p) {
    const auto behind = background_of(state.passes[p], background);
    const int sums = channel_sums(state.passes[p], out);
    const BlendBackwardArgs blend = {.forward = blend_args(state, p, background.empty() ? nullptr : behind.data()),
                                     .grad_colors = grad_colors.empty() ? nullptr : grad_colors.data(),
                                     .grad_alphas = grad_alphas.empty() || p > 0 ? nullptr : grad_alphas.data(),
                                     .channel_sums = sums,
                                     .slots = s.slots.data()};
    Stopwatch watch;
    pool->run(state.tiles(), [&](std::size_t tile) { k.blend_backward(blend, tile); });
    state.times.blend_backward = (p == 0 ? 0.0 : state.times.blend_backward) + watch.lap();
    const auto pointer = [](std::span<float> span) { return span.empty() ? nullptr : span.data(); };
    const ProjectBackwardArgs project = {.forward = project_args(state, g),
                                         .blocks = state.blocks.data(),
                                         .slots = s.slots.data(),
                                         .pass = &state.passes[p],
                                         .channel_sums = sums,
                                         .depth_in_pass = state.passes[p].depth_first,
                                         .carried = passes > 1 ? s.carried.data() : nullptr,
                                         .first = p == 0,
                                         .last = p + 1 == passes,
                                         .accumulate = out.accumulate,
                                         .means = pointer(out.means),
                                         .quats = pointer(out.quats),
                                         .scales = pointer(out.scales),
                                         .opacities = pointer(out.opacities),
                                         .colors = pointer(out.colors),
                                         .viewmat = out.viewmat.empty() ? nullptr : s.viewmat.data()};
    pool->run(state.blocks.size(), [&](std::size_t b) { k.project_backward(project, b); });
    state.times.project_backward = (p == 0 ? 0.0 : state.times.project_backward) + watch.lap();
  }
  for (std::size_t b = 0; b < state.blocks.size() && !out.viewmat.empty(); ++b) {
    for (std::size_t i = 0; i < 12; ++i) {
      out.viewmat[i] += s.viewmat[b * 12 + i];
    }
  }
}

void describe_projections(const RasterState& state, std::span<const float> opacities, const Projections& out) {
  require(opacities.size() == state.count, "opacities is not (N,)");
  require(out.means2d.size() == 2 * state.count && out.depths.size() == state.count &&
              out.conics.size() == 3 * state.count && out.radii.size() == 2 * state.count &&
              out.tiles_touched.size() == state.count,
          "an output has a wrong size");
  constexpr double kRootHalfLog2e = 0.84932180028801904;  // d of Record in standard deviations
  for (std::size_t i = 0; i < state.count; ++i) {
    const Placement& place = state.placements[i];
    const bool visible = place.nx != 0;
    const Record& r = state.records[i];
    const double l11 = visible ? r.l11 / kRootHalfLog2e : 0.0;
    const double l21 = visible ? r.l21 / kRootHalfLog2e : 0.0;
    const double l22 = visible ? r.l22 / kRootHalfLog2e : 0.0;
    out.means2d[2 * i] = visible ? r.mx : 0.0F;
    out.means2d[2 * i + 1] = visible ? r.my : 0.0F;
    out.depths[i] = std::bit_cast<float>(visible ? place.depth_bits : 0U);
    out.conics[3 * i] = static_cast<float>(l11 * l11);
    out.conics[3 * i + 1] = static_cast<float>(l11 * l21);
    out.conics[3 * i + 2] = static_cast<float>(l21 * l21 + l22 * l22);
    out.tiles_touched[i] = std::int32_t{place.nx} * std::int32_t{place.ny};
    const double sigmas = std::min(static_cast<double>(kMaxSigmas),
                                   std::sqrt(2.0 * std::log(255.0 * std::max(opacities[i], 1.0F / 255.0F))));
    const double sx = visible ? std::hypot(l21, l22) / (l11 * l22) : 0.0;
    const double sy = visible ? 1.0 / l22 : 0.0;
    out.radii[2 * i] = static_cast<std::int32_t>(std::min(1e9, std::ceil(sigmas * sx)));
    out.radii[2 * i + 1] = static_cast<std::int32_t>(std::min(1e9, std::ceil(sigmas * sy)));
  }
}

std::span<const std::uint32_t> visible_ids(const RasterState& state) { return state.ids.span(); }

TileInfo tile_info(const RasterState& state) {
  return {kTileWidth, kTileHeight, state.columns, state.rows, state.pairs.size(), state.bytes()};
}

}  // namespace splatbot
