// SPDX-License-Identifier: Apache-2.0
// Every camera model with Gaussians all around it, and the queries of a finished render, under the sanitizers. The
// number of threads changes no bit.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <random>
#include <string>
#include <vector>

#include "promises.hpp"
#include "scene.hpp"
#include "splatbot/fronts.hpp"
#include "splatbot/rasterizer.hpp"
#include "splatbot/threads.hpp"

namespace {

using namespace splatbot;

struct Cloud : Scene {
  explicit Cloud(std::size_t n) {
    std::mt19937 random(3);
    std::normal_distribution<float> normal;
    std::uniform_real_distribution<float> uniform(0.0F, 1.0F);
    for (std::size_t i = 0; i < n; ++i) {
      const float wide = i % 5 == 0 ? 50.0F : i % 7 == 0 ? 1e-6F : 1.0F;
      means.insert(means.end(), {wide * normal(random), wide * normal(random), 1.0F + normal(random)});
      for (int k = 0; k < 4; ++k) {
        quats.push_back(normal(random));
      }
      for (int k = 0; k < 3; ++k) {
        scales.push_back(i % 17 == 0 ? 1e3F : i % 19 == 0 ? 0.0F : std::pow(10.0F, -3.0F + 2.5F * uniform(random)));
      }
      opacities.push_back(uniform(random));
      colors.insert(colors.end(), {uniform(random), uniform(random), uniform(random)});
    }
  }
};

View view_through(const Lens& lens, int width, int height) {
  View view = view_of(30.0F, 25.0F, width, height);
  view.lens = lens;
  return view;
}

std::vector<Lens> lenses() {
  std::vector<Lens> all;
  for (const CameraModel model : {CameraModel::pinhole, CameraModel::ortho, CameraModel::fisheye}) {
    Lens lens;
    lens.model = model;
    all.push_back(lens);
    lens.unscented = true;
    lens.spread = 0.1 * std::sqrt(3.0);
    lens.weight = 0.5 / 0.03;
    lens.excess = 1.99;
    lens.nearest = 0.01;
    lens.limit = model == CameraModel::fisheye ? 3.0 : 2.0;
    if (model != CameraModel::ortho) {
      lens.radial[0] = -0.05;
      lens.radial[1] = 0.01;
    }
    all.push_back(lens);
    for (const Shutter shutter :
         {Shutter::top_to_bottom, Shutter::left_to_right, Shutter::bottom_to_top, Shutter::right_to_left}) {
      lens.shutter = shutter;
      lens.turn[1] = 0.2;
      lens.step[0] = 0.1;
      all.push_back(lens);
    }
  }
  return all;
}

struct Render {
  std::vector<float> image, alphas, means, quats, scales, opacities;
  std::vector<double> camera;
  std::vector<std::int32_t> medians, fronts;
  std::vector<float> weights;

  bool operator==(const Render& other) const = default;
};

Render render(const Cloud& cloud, const View& view) {
  const Gaussians g = cloud.gaussians();
  const auto pixels = static_cast<std::size_t>(view.width) * static_cast<std::size_t>(view.height);
  Render r;
  r.image.resize(4 * pixels);
  r.alphas.resize(pixels);
  RasterStatePtr state;
  const RasterOptions options = {.depth = DepthMode::expected, .antialiased = true};
  promise(!rasterize_forward(g, view, options, {}, {}, r.image, r.alphas, state), "finite inputs are no fault");
  r.means.resize(g.means.size());
  r.quats.resize(g.quats.size());
  r.scales.resize(g.scales.size());
  r.opacities.resize(g.count);
  r.camera.resize(kCameraSums);
  const std::vector<float> grad(4 * pixels, 0.5F);
  Gradients out{};
  out.means = r.means;
  out.quats = r.quats;
  out.scales = r.scales;
  out.opacities = r.opacities;
  out.camera = r.camera;
  rasterize_backward(*state, g, {}, grad, {}, out);
  for (const auto* values : {&r.image, &r.alphas, &r.means, &r.quats, &r.scales, &r.opacities}) {
    promise(std::all_of(values->begin(), values->end(), [](float x) { return std::isfinite(x); }),
            "images and gradients are finite");
  }
  r.medians.resize(pixels);
  median_gaussians(*state, r.medians);
  std::vector<std::int64_t> asked;
  for (std::size_t i = 0; i < pixels; i += 7) {
    asked.push_back(static_cast<std::int64_t>(pixels - 1 - i));
  }
  r.fronts.resize(3 * asked.size());
  r.weights.resize(3 * asked.size());
  front_gaussians(*state, asked, 3, r.fronts, r.weights);
  std::vector<std::uint32_t> ids;
  promise(!find_visible(g, view, options, ids), "finite inputs are no fault");
  const auto seen = visible_ids(*state);
  promise(std::equal(ids.begin(), ids.end(), seen.begin(), seen.end()), "what is visible is what is rendered");
  return r;
}

}  // namespace

void check_cameras(const std::string& isa) {
  int renders = 0;
  for (const auto& [width, height] : {std::pair{1, 1}, {45, 70}}) {
    for (const std::size_t n : {std::size_t{0}, std::size_t{1}, std::size_t{1500}}) {
      const Cloud cloud(n);
      for (const Lens& lens : lenses()) {
        const View view = view_through(lens, width, height);
        set_num_threads(1);
        const Render want = render(cloud, view);
        set_num_threads(8);
        promise(render(cloud, view) == want, "threads change no bit");
        ++renders;
      }
    }
  }
  std::printf("%s: %d renders through other cameras\n", isa.c_str(), renders);
}
