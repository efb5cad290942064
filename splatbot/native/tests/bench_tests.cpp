// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <cstdio>
#include <vector>

#include "peak.hpp"
#include "promises.hpp"
#include "scalar_baseline.hpp"
#include "scene.hpp"
#include "splatbot/isa.hpp"

using namespace splatbot;

void check_bench() {
  for (const std::string& isa : available_isas()) {
    promise(multiply_add_peak(isa, 2, 1.0) > 0.0, "the yardstick runs");
  }
  Scene scene;
  scene.means = {0.0F, -0.195F, 2.0F};
  scene.quats = {1.0F, 0.0F, 0.0F, 0.0F};
  scene.scales = {0.1F, 0.1F, 0.1F};
  scene.opacities = {0.5F};
  scene.colors = {1.0F, 0.5F, 0.25F};
  const View view = view_of(40.0F, 40.0F, 41, 41);
  const std::size_t pixels = 41 * 41, center = 12 * 41 + 20;
  std::vector<float> image(3 * pixels), alphas(pixels), grad_colors(3), grad_opacities(1), grad_means(2), grad_conics(3);
  const std::vector<float> grad(3 * pixels, 1.0F);
  scalar_baseline(scene.gaussians(), view, {}, image, alphas, grad, {grad_colors, grad_opacities, grad_means, grad_conics});
  promise(std::fabs(alphas[center] - 0.5F) < 1e-6F && std::fabs(image[3 * center + 2] - 0.125F) < 1e-6F,
          "the plain renderer shows a Gaussian at its centre");
  promise(grad_colors[0] > 0.0F && grad_opacities[0] > 0.0F && std::fabs(grad_means[0]) < 1e-4F,
          "its gradients have the signs of the scene");
  std::puts("yardsticks of the benchmark");
}
