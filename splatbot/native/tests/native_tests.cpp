// SPDX-License-Identifier: Apache-2.0
// Runs the rasterizer through its hard corners, on every instruction set of this CPU, under the sanitizers. Checks
// that the number of threads changes no bit. Prints its steps; exits 1 at the first broken promise.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

#include "optimize_tests.hpp"
#include "promises.hpp"
#include "scene.hpp"
#include "splatbot/isa.hpp"
#include "splatbot/rasterizer.hpp"
#include "splatbot/surfels.hpp"
#include "splatbot/threads.hpp"

namespace {

using namespace splatbot;

// Gaussians in front of, behind and next to the camera, thin, huge, opaque and invisible, with odd quaternions.
Scene make_scene(std::size_t n, int channels, unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<float> normal;
  std::uniform_real_distribution<float> uniform(0.0F, 1.0F);
  Scene s;
  s.channels = channels;
  for (std::size_t i = 0; i < n; ++i) {
    const float far_off = i % 11 == 0 ? 1e6F : 1.0F;
    s.means.insert(s.means.end(), {far_off * normal(random), normal(random), 2.0F + 1.5F * normal(random)});
    const float norm = i % 13 == 0 ? 0.0F : i % 7 == 0 ? 1e-20F : i % 5 == 0 ? 1e18F : 1.0F;
    for (int k = 0; k < 4; ++k) {
      s.quats.push_back(norm * normal(random));
    }
    for (int k = 0; k < 3; ++k) {
      s.scales.push_back(i % 17 == 0 ? 1e4F : i % 19 == 0 ? 0.0F : std::pow(10.0F, -4.0F + 3.5F * uniform(random)));
    }
    s.opacities.push_back(i % 3 == 0 ? 1.0F : i % 23 == 0 ? 0.0F : uniform(random));
    for (int c = 0; c < channels; ++c) {
      s.colors.push_back(uniform(random));
    }
  }
  return s;
}

// The scene's scales along the world's axes, as covariances.
void use_covars(Scene& s) {
  for (std::size_t i = 0; i < s.opacities.size(); ++i) {
    for (std::size_t k = 0; k < 9; ++k) {
      const float scale = s.scales[3 * i + k / 3];
      s.covars.push_back(k % 4 == 0 ? scale * scale : 0.0F);
    }
  }
  if (!s.covars.empty()) {
    s.quats.clear();
    s.scales.clear();
  }
}

void use_harmonics(Scene& s, int degree, unsigned seed) {
  std::mt19937 random(seed);
  std::normal_distribution<float> normal;
  s.sh_degree = degree;
  s.coefficients = 25;
  s.channels = 3;
  s.colors.resize(s.opacities.size() * 75);
  for (float& value : s.colors) {
    value = normal(random);
  }
}

View make_view(int width, int height) { return view_of(60.0F, 60.0F, width, height); }

struct Result {
  std::vector<float> image, alphas, means, quats, scales, covars, opacities, colors, means2d, absolute2d;
  std::vector<double> camera, background;
  std::vector<std::int32_t> contributions;

  bool operator==(const Result& other) const {
    const auto same = [](const auto& a, const auto& b) {
      return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(a[0])) == 0);
    };
    return same(image, other.image) && same(alphas, other.alphas) && same(means, other.means) &&
           same(quats, other.quats) && same(scales, other.scales) && same(opacities, other.opacities) &&
           same(colors, other.colors) && same(covars, other.covars) && same(means2d, other.means2d) &&
           same(absolute2d, other.absolute2d) && same(camera, other.camera) && same(background, other.background) &&
           same(contributions, other.contributions);
  }
};

Result render(const Scene& scene, const View& view, const RasterOptions& options, bool masked = false) {
  const Gaussians g = scene.gaussians();
  const std::size_t pixels = static_cast<std::size_t>(view.width) * static_cast<std::size_t>(view.height);
  const std::size_t columns =
      static_cast<std::size_t>(scene.channels) + (options.depth != DepthMode::none ? 1U : 0U);
  Result r;
  r.image.resize(pixels * columns);
  r.alphas.resize(pixels);
  const std::vector<float> background(static_cast<std::size_t>(scene.channels), 0.25F);
  RasterStatePtr state;
  constexpr int kMaskSize = 5;
  std::vector<std::uint8_t> keep;
  if (masked) {
    keep.resize(static_cast<std::size_t>((view.width + kMaskSize - 1) / kMaskSize) *
                static_cast<std::size_t>((view.height + kMaskSize - 1) / kMaskSize));
    for (std::size_t i = 0; i < keep.size(); ++i) {
      keep[i] = i % 3 != 0 ? 1 : 0;
    }
  }
  const TileMask mask = {.keep = keep, .size = kMaskSize};
  promise(!rasterize_forward(g, view, options, background, mask, r.image, r.alphas, state),
        "finite inputs are no fault");
  for (const float alpha : r.alphas) {
    promise(alpha >= 0.0F && alpha <= 1.0F, "alpha lies in 0..1");
  }
  std::vector<float> grad_image(r.image.size());
  for (std::size_t i = 0; i < grad_image.size(); ++i) {
    grad_image[i] = static_cast<float>(i % 7) - 3.0F;
  }
  for (const float value : r.image) {
    promise(std::isfinite(value), "the image is finite");
  }
  const std::vector<float> grad_alphas(pixels, 0.5F);
  r.means.resize(g.means.size());
  r.quats.resize(g.quats.size());
  r.scales.resize(g.scales.size());
  r.opacities.resize(g.count);
  r.colors.resize(g.colors.size());
  r.covars.resize(g.covars.size());
  r.means2d.resize(2 * g.count);
  r.absolute2d.resize(2 * g.count);
  r.camera.resize(kCameraSums);
  r.contributions.resize(g.count);
  r.background.resize(background.size());
  const Gradients out = {.means = r.means,
                         .quats = r.quats,
                         .scales = r.scales,
                         .covars = r.covars,
                         .opacities = r.opacities,
                         .colors = r.colors,
                         .camera = r.camera,
                         .background = r.background,
                         .means2d = r.means2d,
                         .absolute2d = r.absolute2d};
  rasterize_backward(*state, g, background, grad_image, grad_alphas, out);
  for (const auto* gradient : {&r.means, &r.quats, &r.scales, &r.covars, &r.opacities, &r.colors, &r.means2d}) {
    for (const float value : *gradient) {
      promise(std::isfinite(value), "gradients are finite");
    }
  }
  std::vector<float> means2d(2 * g.count), depths(g.count), conics(3 * g.count), opacities(g.count);
  std::vector<std::int32_t> radii(2 * g.count);
  describe_projections(*state, {means2d, depths, conics, radii, opacities});
  count_contributions(*state, r.contributions);
  for (const std::int32_t count : r.contributions) {
    promise(count >= 0 && static_cast<std::size_t>(count) <= pixels, "a Gaussian counts in no more pixels than there are");
  }
  promise(visible_ids(*state).size() <= g.count, "no more Gaussians are seen than there are");
  return r;
}

void run_all(const std::string& isa) {
  int renders = 0;
  for (const auto& [width, height] : {std::pair{1, 1}, {3, 70}, {32, 16}, {97, 41}}) {
    for (const std::size_t n : {std::size_t{0}, std::size_t{1}, std::size_t{63}, std::size_t{2500}}) {
      for (const int channels : {0, 1, 3, 7, 11}) {
        const Scene scene = make_scene(n, channels, 7);
        for (const DepthMode depth : {DepthMode::none, DepthMode::accumulated, DepthMode::expected}) {
          if (channels == 0 && depth == DepthMode::none) {
            continue;
          }
          const RasterOptions options = {.depth = depth, .plane_depth = channels % 2 == 1};
          set_num_threads(1);
          const Result want = render(scene, make_view(width, height), options);
          for (const unsigned threads : {2U, 8U}) {
            set_num_threads(threads);
            promise(render(scene, make_view(width, height), options) == want, "threads change no bit");
          }
          ++renders;
        }
      }
    }
  }
  std::printf("%s: %d renders, forward and backward, on 1, 2 and 8 threads\n", isa.c_str(), renders);
}

void run_variants(const std::string& isa) {
  int renders = 0;
  for (const std::size_t n : {std::size_t{0}, std::size_t{1}, std::size_t{40}, std::size_t{2500}}) {
    for (int degree = -1; degree <= kMaxHarmonicsDegree; ++degree) {
      for (const bool of_covars : {false, true}) {
        Scene scene = make_scene(n, 3, 11);
        if (of_covars) {
          use_covars(scene);
        }
        if (degree >= 0) {
          use_harmonics(scene, degree, 3);
        }
        const RasterOptions options = {.depth = degree % 2 == 0 ? DepthMode::expected : DepthMode::none,
                                       .antialiased = degree % 3 == 0};
        set_num_threads(1);
        const Result want = render(scene, make_view(70, 45), options, true);
        set_num_threads(3);
        promise(render(scene, make_view(70, 45), options, true) == want, "threads change no bit of any variant");
        ++renders;
      }
    }
  }
  std::printf("%s: %d renders of harmonics, covariances, masks and antialiasing\n", isa.c_str(), renders);
}

// All images and gradients of a render of surfels, one after the other.
std::vector<float> render_surfels(const Scene& scene, const View& view, const SurfelOptions& options) {
  const Gaussians g = scene.gaussians();
  const std::size_t pixels = static_cast<std::size_t>(view.width) * static_cast<std::size_t>(view.height);
  const std::size_t columns =
      static_cast<std::size_t>(scene.channels) + (options.depth != DepthMode::none ? 1U : 0U);
  std::vector<float> colors(pixels * columns), alphas(pixels), normals(3 * pixels), median(pixels);
  std::vector<float> distortion(options.distortion ? pixels : 0);
  const std::vector<float> background(static_cast<std::size_t>(scene.channels), 0.25F);
  SurfelStatePtr state;
  promise(!surfels_forward(g, view, options, background, {colors, alphas, normals, median, distortion}, state),
        "finite inputs are no fault");
  std::vector<float> grad_colors(colors.size());
  for (std::size_t i = 0; i < grad_colors.size(); ++i) {
    grad_colors[i] = static_cast<float>(i % 7) - 3.0F;
  }
  const std::vector<float> ones(3 * pixels, 1.0F);
  const auto some = std::span<const float>(ones).first(pixels);
  const auto distorted = some.first(distortion.size());
  std::vector<float> means(g.means.size()), quats(g.quats.size()), scales(g.scales.size()), opacities(g.count);
  std::vector<float> channels(g.colors.size()), means2d(2 * g.count);
  std::vector<double> camera(kCameraSums), behind(background.size());
  const Gradients out = {.means = means,
                         .quats = quats,
                         .scales = scales,
                         .covars = {},
                         .opacities = opacities,
                         .colors = channels,
                         .camera = camera,
                         .background = behind,
                         .means2d = means2d,
                         .absolute2d = {}};
  surfels_backward(*state, g, background, {grad_colors, some, ones, some, distorted}, out);
  std::vector<float> depths(g.count), facing(3 * g.count);
  std::vector<std::int32_t> radii(2 * g.count), tiles(g.count);
  std::vector<float> centers(2 * g.count);
  describe_surfels(*state, {centers, depths, facing, radii, tiles});
  std::vector<float> all(camera.begin(), camera.end());
  for (const auto* part : {&colors, &alphas, &normals, &median, &distortion, &means, &quats, &scales, &opacities,
                           &channels, &means2d, &depths, &facing}) {
    all.insert(all.end(), part->begin(), part->end());
  }
  for (const float value : all) {
    promise(std::isfinite(value), "images and gradients of surfels are finite");
  }
  return all;
}

void run_surfels(const std::string& isa) {
  int renders = 0;
  for (const auto& [width, height] : {std::pair{1, 1}, {3, 70}, {97, 41}}) {
    for (const std::size_t n : {std::size_t{0}, std::size_t{1}, std::size_t{2500}}) {
      for (const int channels : {0, 3, 8}) {
        Scene scene = make_scene(n, channels, 7);
        if (channels == 3 && width == 97) {
          use_harmonics(scene, 4, 3);
        }
        const SurfelOptions options = {.depth = channels == 3 ? DepthMode::accumulated : DepthMode::expected,
                                       .distortion = channels != 8};
        set_num_threads(1);
        const std::vector<float> want = render_surfels(scene, make_view(width, height), options);
        for (const unsigned threads : {2U, 8U}) {
          set_num_threads(threads);
          const std::vector<float> got = render_surfels(scene, make_view(width, height), options);
          promise(got.size() == want.size() && std::memcmp(got.data(), want.data(), got.size() * sizeof(float)) == 0,
                "threads change no bit of surfels");
        }
        ++renders;
      }
    }
  }
  std::printf("%s: %d renders of surfels, forward and backward, on 1, 2 and 8 threads\n", isa.c_str(), renders);
}

void check_errors() {
  Scene scene = make_scene(5000, 3, 1);
  scene.scales[3 * 4321 + 1] = std::nanf("");
  std::vector<float> image(32 * 16 * 3), alphas(32 * 16);
  RasterStatePtr state;
  const auto fault = rasterize_forward(scene.gaussians(), make_view(32, 16), {}, {}, {}, image, alphas, state);
  promise(fault && fault->field == "scales" && fault->row == 4321, "a NaN is found with its field and row");
  bool thrown = false;
  try {
    rasterize_forward(make_scene(5, 3, 1).gaussians(), make_view(33, 16), {}, {}, {}, image, alphas, state);
  } catch (const std::invalid_argument&) {
    thrown = true;
  }
  promise(thrown, "an output of a wrong size is refused");
}

void check_pool() {
  ThreadPool pool(4);
  bool thrown = false;
  try {
    pool.run(1000, [](std::size_t i) {
      if (i == 500) {
        throw std::runtime_error("task");
      }
    });
  } catch (const std::runtime_error&) {
    thrown = true;
  }
  promise(thrown, "a task's exception reaches the caller");
  std::vector<int> done(1000, 0);
  pool.run(done.size(), [&](std::size_t i) { ++done[i]; });
  for (const int count : done) {
    promise(count == 1, "every task runs once, also after an exception");
  }
}

}  // namespace

int main() {
  check_pool();
  check_errors();
  check_path_speed();
  check_depth();
  check_measurements();
  check_bench();
  for (const std::string& isa : available_isas()) {
    set_isa(isa);
    run_all(isa);
    run_surfels(isa);
    check_cameras(isa);
    check_collision(isa);
    check_planning();
    run_variants(isa);
    run_optimize();
  }
  std::puts("all promises kept");
  return 0;
}
