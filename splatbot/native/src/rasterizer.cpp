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

std::size_t color_columns(const Gaussians& g) {
  return static_cast<std::size_t>(g.sh_degree < 0 ? g.channels : 3 * g.coefficients);
}

void check_gaussians(const Gaussians& g) {
  require(g.count < (std::size_t{1} << 32) - 1 && g.channels >= 0, "too many Gaussians");
  require(g.means.size() == 3 * g.count, "means is not (N, 3)");
  const bool axes = g.covars.empty();
  require(axes ? g.quats.size() == 4 * g.count : g.quats.empty(), "quats is not (N, 4), or given beside covars");
  require(axes ? g.scales.size() == 3 * g.count : g.scales.empty(), "scales is not (N, 3), or given beside covars");
  require(empty_or(g.covars, 9 * g.count), "covars is not (N, 3, 3)");
  require(g.opacities.size() == g.count, "opacities is not (N,)");
  require(g.sh_degree >= -1 && g.sh_degree <= kMaxHarmonicsDegree, "the degree of the harmonics is not in 0..4");
  require(g.sh_degree < 0 || (g.channels == 3 && g.coefficients >= (g.sh_degree + 1) * (g.sh_degree + 1)),
          "too few coefficients for this degree");
  require(g.colors.size() == g.count * color_columns(g), "colors has a wrong size");
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
          .covars = g.covars.empty() ? nullptr : g.covars.data(),
          .opacities = g.opacities.data(),
          .colors = g.colors.data(),
          .channels = state.channels,
          .sh_degree = g.sh_degree,
          .coefficients = g.coefficients,
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
          .mask = state.mask.size() == 0 ? nullptr : state.mask.data(),
          .mask_size = state.mask_size,
          .mask_columns = state.mask_columns,
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

HarmonicsArgs harmonics_args(const RasterState& state, const ProjectArgs& project) {
  return {.forward = project,
          .blocks = state.blocks.data(),
          .first_channel = state.options.depth != DepthMode::none ? 1 : 0};
}

std::optional<Fault> find_fault(const RasterState& state) {
  static constexpr std::string_view kFields[] = {"means", "quats", "scales", "covars", "opacities", "colors"};
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
  const bool position = !out.means.empty() || !out.camera.empty() || !out.means2d.empty();
  return pass.depth_first && position ? 1 : 0;
}

struct BackwardScratch {
  Buffer<float> slots, carried, colors;
  Buffer<double> camera, center;
};

// What the passes sum of a camera's gradient: about the view's origin, and to the camera's centre.
struct CameraGradient {
  std::array<double, kCameraSums> sums{};
  std::array<double, 3> center{};
};

// The camera sees R (x - origin) + translation = R x + t, and its centre is -R^-1 t.
void add_camera_gradient(const View& view, const CameraGradient& from, std::span<double> out) {
  const auto r = [&](std::size_t i, std::size_t j) { return static_cast<double>(view.rotation[3 * (i % 3) + j % 3]); };
  double determinant = 0.0;
  std::array<double, 3> pulled{};  // R^-T times the gradient to the centre, times det R
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      const double cofactor = r(i + 1, j + 1) * r(i + 2, j + 2) - r(i + 1, j + 2) * r(i + 2, j + 1);
      pulled[i] += cofactor * from.center[j];
      determinant += i == 0 ? cofactor * r(0, j) : 0.0;
    }
  }
  for (std::size_t i = 0; i < kCameraSums; ++i) {
    out[i] += from.sums[i];
  }
  for (std::size_t i = 0; i < 3; ++i) {
    const double shift = -pulled[i] / determinant;
    for (std::size_t j = 0; j < 3; ++j) {
      const double origin = static_cast<double>(view.origin[j]);
      out[3 * i + j] += from.sums[9 + i] * origin + shift * (origin + static_cast<double>(view.center_low[j]));
    }
    out[9 + i] += shift;
  }
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

BackwardScratch& scratch() {
  static thread_local BackwardScratch instance;
  return instance;
}

}  // namespace

std::size_t RasterState::bytes() const noexcept {
  return records.capacity_bytes() + placements.capacity_bytes() + visible.capacity_bytes() + ids.capacity_bytes() +
         more_channels.capacity_bytes() + order.capacity_bytes() + order_scratch.capacity_bytes() +
         histogram.capacity_bytes() + tile_begin.capacity_bytes() + pairs.capacity_bytes() + masks.capacity_bytes() +
         tile_done.capacity_bytes() + final_state.capacity_bytes() + mask.capacity_bytes();
}

std::optional<Fault> rasterize_forward(const Gaussians& g, const View& view, const RasterOptions& options,
                                       std::span<const float> background, const TileMask& mask,
                                       std::span<float> out_colors, std::span<float> out_alphas,
                                       RasterStatePtr& result) {
  check_gaussians(g);
  check_view(view);
  const std::size_t pixels = static_cast<std::size_t>(view.width) * static_cast<std::size_t>(view.height);
  const RasterStatePtr shared = new_state();
  RasterState& state = *shared;
  prepare(state, g, view, options);
  require(empty_or(background, static_cast<std::size_t>(g.channels)), "background is not (channels,)");
  require(out_colors.size() == pixels * static_cast<std::size_t>(state.out_channels), "out_colors has a wrong size");
  require(out_alphas.size() == pixels, "out_alphas has a wrong size");
  keep_mask(state, mask);

  const Kernels& k = kernels();
  const std::shared_ptr<ThreadPool> pool = thread_pool();
  Stopwatch watch;
  const ProjectArgs project = project_args(state, g);
  pool->run(state.blocks.size(), [&](std::size_t b) { k.project(project, b, state.blocks[b]); });
  state.times = {.project = watch.lap()};
  if (const std::optional<Fault> fault = find_fault(state)) {
    return fault;
  }
  if (g.sh_degree >= 0) {
    const HarmonicsArgs colors = harmonics_args(state, project);
    pool->run(state.blocks.size(), [&](std::size_t b) { k.harmonics(colors, b); });
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
  require(empty_or(out.means, 3 * g.count) && empty_or(out.quats, g.quats.size()) &&
              empty_or(out.scales, g.scales.size()) && empty_or(out.covars, g.covars.size()) &&
              empty_or(out.opacities, g.count) && empty_or(out.colors, g.colors.size()) &&
              empty_or(out.camera, std::size_t{kCameraSums}) && empty_or(out.means2d, 2 * g.count) &&
              empty_or(out.absolute2d, 2 * g.count) &&
              empty_or(out.background, static_cast<std::size_t>(g.channels)),
          "a gradient has a wrong size");

  const Kernels& k = kernels();
  const std::shared_ptr<ThreadPool> pool = thread_pool();
  if (!out.accumulate) {
    std::fill(out.camera.begin(), out.camera.end(), 0.0);
    std::fill(out.background.begin(), out.background.end(), 0.0);
  }
  if (!out.background.empty() && !grad_colors.empty()) {
    add_background_gradient(state, grad_colors, out.background);
  }
  const bool geometry = !(out.means.empty() && out.quats.empty() && out.scales.empty() && out.covars.empty() &&
                          out.opacities.empty() && out.camera.empty() && out.means2d.empty() &&
                          out.absolute2d.empty());
  if (!geometry && out.colors.empty()) {
    return;
  }
  // Harmonics of degree 1 and up depend on where the Gaussian and the camera are.
  const bool harmonics = g.sh_degree >= 0;
  const bool harmonics_move = g.sh_degree > 0 && !(out.means.empty() && out.camera.empty());
  const bool harmonics_wanted = harmonics && (harmonics_move || !out.colors.empty());

  BackwardScratch& s = scratch();
  const std::size_t passes = state.passes.size();
  s.slots.resize(state.pairs.size() * kSlot);
  s.carried.resize(passes > 1 ? g.count * kSlot : 0);
  s.camera.resize(out.camera.empty() ? 0 : state.blocks.size() * kCameraSums);
  s.colors.resize(harmonics_wanted ? 3 * g.count : 0);
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
                                         .accumulate_colors = out.accumulate && !harmonics,
                                         .geometry = geometry,
                                         .means = pointer(out.means),
                                         .quats = pointer(out.quats),
                                         .scales = pointer(out.scales),
                                         .covars = pointer(out.covars),
                                         .opacities = pointer(out.opacities),
                                         .colors = harmonics_wanted ? s.colors.data() : pointer(out.colors),
                                         .means2d = pointer(out.means2d),
                                         .absolute2d = pointer(out.absolute2d),
                                         .camera = out.camera.empty() ? nullptr : s.camera.data()};
    pool->run(state.blocks.size(), [&](std::size_t b) { k.project_backward(project, b); });
    state.times.project_backward = (p == 0 ? 0.0 : state.times.project_backward) + watch.lap();
  }
  CameraGradient camera;
  for (std::size_t b = 0; b < state.blocks.size() && !out.camera.empty(); ++b) {
    for (std::size_t i = 0; i < kCameraSums; ++i) {
      camera.sums[i] += s.camera[b * kCameraSums + i];
    }
  }
  if (harmonics_wanted) {
    s.center.resize(out.camera.empty() ? 0 : 3 * state.blocks.size());
    const HarmonicsBackwardArgs args = {.forward = harmonics_args(state, project_args(state, g)),
                                        .colors = s.colors.data(),
                                        .accumulate = out.accumulate,
                                        .coefficients = out.colors.empty() ? nullptr : out.colors.data(),
                                        .means = out.means.empty() ? nullptr : out.means.data(),
                                        .center = out.camera.empty() ? nullptr : s.center.data()};
    pool->run(state.blocks.size(), [&](std::size_t b) { k.harmonics_backward(args, b); });
    for (std::size_t i = 0; i < s.center.size(); ++i) {
      camera.center[i % 3] += s.center[i];
    }
  }
  if (!out.camera.empty()) {
    add_camera_gradient(state.view, camera, out.camera);
  }
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
  return {kTileWidth, kTileHeight, state.columns, state.rows, state.pairs.size(), state.bytes()};
}

}  // namespace splatbot
