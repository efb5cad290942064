// SPDX-License-Identifier: Apache-2.0
// Gaussians and cameras of the tests.
#pragma once

#include <vector>

#include "splatbot/rasterizer.hpp"

struct Scene {
  int channels = 3;
  std::vector<float> means, quats, scales, opacities, colors;
  std::vector<float> covars = {};  // in place of quats and scales, or empty
  int sh_degree = -1, coefficients = 0;

  splatbot::Gaussians gaussians() const {
    return {.count = opacities.size(),
            .channels = channels,
            .means = means,
            .quats = quats,
            .scales = scales,
            .covars = covars,
            .opacities = opacities,
            .colors = colors,
            .sh_degree = sh_degree,
            .coefficients = coefficients};
  }
};

// A camera at the origin along z, its principal point above the middle. Focal lengths in pixels.
inline splatbot::View view_of(float fx, float fy, int width, int height) {
  splatbot::View view{};
  view.rotation[0] = view.rotation[4] = view.rotation[8] = 1.0F;
  view.fx = fx;
  view.fy = fy;
  view.cx = 0.5F * static_cast<float>(width);
  view.cy = 0.4F * static_cast<float>(height);
  view.width = width;
  view.height = height;
  return view;
}
