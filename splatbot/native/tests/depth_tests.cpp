// SPDX-License-Identifier: Apache-2.0
// Depth images of all shapes, down to one pixel, with holes and NaN, for the sanitizers to watch.
#include <cmath>
#include <cstddef>
#include <limits>
#include <utility>
#include <vector>

#include "promises.hpp"
#include "splatbot/depth.hpp"

namespace {

using namespace splatbot;

// A wall at 1 m on the left half, one at 1.5 m on the right, a hole and a NaN.
std::vector<float> two_walls(int width, int height) {
  std::vector<float> z;
  for (int v = 0; v < height; ++v)
    for (int u = 0; u < width; ++u) z.push_back(u < width / 2 ? 1.0F : 1.5F);
  z[z.size() / 2] = 0.0F;
  z[z.size() / 3] = std::numeric_limits<float>::quiet_NaN();
  return z;
}

void check_shape(int width, int height) {
  const std::vector<float> z = two_walls(width, height), gray(z.size(), 0.5F);
  const DepthImage depth{width, height, z};
  std::vector<float> valid(z.size()), kept(z.size()), smooth(z.size()), normals(3 * z.size());
  std::vector<float> half(static_cast<std::size_t>(width / 2) * (height / 2));
  valid_depth(depth, 0.2F, 6.0F, 0.03F, valid);
  halve_depth(depth, half);
  gray_of_one_surface(depth, gray, 0.02F, 0.01F, 0.01F, kept);
  smooth_depth(depth, 0.04F, 0.01F, 0.01F, smooth);
  normals_of(depth, {100.0, 100.0, 0.5 * width, 0.5 * height}, normals);
  std::vector<float> around(2 * z.size());
  for (std::size_t i = 0; i < around.size(); ++i) around[i] = static_cast<float>(i % 97) - 20.0F;  // also outside
  std::vector<double> medians(z.size());
  depth_around(depth, around, medians);
  for (std::size_t i = 0; i < z.size(); ++i) {
    promise(valid[i] == 0.0F || valid[i] == z[i], "depth is valid or 0");
    promise(std::isnan(kept[i]) || kept[i] == 0.5F, "grey is kept or NaN");
    promise(smooth[i] == (z[i] > 0.0F ? z[i] : 0.0F), "smoothed depth of a wall is its depth");
    const float square = normals[3 * i] * normals[3 * i] + normals[3 * i + 1] * normals[3 * i + 1] +
                         normals[3 * i + 2] * normals[3 * i + 2];
    promise(square == 0.0F || std::abs(square - 1.0F) < 1e-5F, "normals are of length 1 or 0");
    promise(z[i] > 0.0F || square == 0.0F, "there is no normal where there is no depth");
    promise(std::isnan(medians[i]) || medians[i] > 0.0, "depth around a pixel is positive or NaN");
  }
  for (const float d : half) promise(d == 0.0F || (d >= 1.0F && d <= 1.5F), "halved depth is of one of the walls");
}

}  // namespace

void check_depth() {
  for (const auto& [width, height] : {std::pair{1, 1}, {1, 7}, {7, 1}, {2, 2}, {3, 3}, {5, 4}, {33, 17}, {64, 48}}) {
    check_shape(width, height);
  }
}
