// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <cstdio>
#include <vector>

#include "peak.hpp"
#include "promises.hpp"
#include "scalar_baseline.hpp"
#include "splatbot/isa.hpp"

using namespace splatbot;

void check_bench() {
  for (const std::string& isa : available_isas()) {
    promise(multiply_add_peak(isa, 2, 1.0) > 0.0, "the yardstick runs");
  }
  const std::vector<float> means = {0.0F, 0.0F, 2.0F}, quats = {1.0F, 0.0F, 0.0F, 0.0F}, scales(3, 0.1F);
  const std::vector<float> opacities = {0.5F}, colors = {1.0F, 0.5F, 0.25F};
  Gaussians g{};
  g.count = 1;
  g.channels = 3;
  g.means = means;
  g.quats = quats;
  g.scales = scales;
  g.opacities = opacities;
  g.colors = colors;
  View view{};
  view.rotation[0] = view.rotation[4] = view.rotation[8] = 1.0F;
  view.fx = view.fy = 40.0F;
  view.cx = view.cy = 20.5F;
  view.width = view.height = 41;
  const std::size_t pixels = 41 * 41, center = 20 * 41 + 20;
  std::vector<float> image(3 * pixels), alphas(pixels), grad_colors(3), grad_opacities(1), grad_means(2), grad_conics(3);
  const std::vector<float> grad(3 * pixels, 1.0F);
  scalar_baseline(g, view, {}, image, alphas, grad, {grad_colors, grad_opacities, grad_means, grad_conics});
  promise(std::fabs(alphas[center] - 0.5F) < 1e-6F && std::fabs(image[3 * center + 2] - 0.125F) < 1e-6F,
          "the plain renderer shows a Gaussian at its centre");
  promise(grad_colors[0] > 0.0F && grad_opacities[0] > 0.0F && std::fabs(grad_means[0]) < 1e-4F,
          "its gradients have the signs of the scene");
  std::puts("yardsticks of the benchmark");
}
