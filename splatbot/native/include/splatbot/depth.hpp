// SPDX-License-Identifier: Apache-2.0
// Depth images [m], 0 where nothing was measured: what tracking takes from them.
#pragma once

#include <span>

namespace splatbot {

struct DepthImage {
  int width = 0, height = 0;
  std::span<const float> z;  // (H, W)
};

// out (H, W): z within [near, far] that is not flying between two surfaces, else 0. A pixel flies that is nearer than one
// neighbour and farther than the opposite one by more than `step` of its own depth; a missing neighbour speaks for it.
void valid_depth(const DepthImage& depth, float near, float far, float step, std::span<float> out);

// out (H / 2, W / 2): the mean over each 2x2 block's pixels within 5 % of its nearest one; 0 where none is measured.
void halve_depth(const DepthImage& depth, std::span<float> out);

// out (N,): median over the measured ones of the 5x5 pixels around each of the pixels (N, 2); NaN where none is, or where
// they span more than 5 % of it: two surfaces.
void depth_around(const DepthImage& depth, std::span<const float> pixels, std::span<double> out);

// out (H, W): gray (H, W), NaN where surfaces of different depth meet: where inverse depth, which is linear along a plane
// however slanted, bends between a measured pixel's opposite neighbours by what is both `step` of its depth z and
// floor + quad z^2 [m] of it.
void gray_of_one_surface(const DepthImage& depth, std::span<const float> gray, float step, float floor, float quad,
                         std::span<float> out);

// out (H, W): the mean of each measured pixel and of those pairs of opposite neighbours, of its 3x3, that are of its surface:
// both measured, within `step` of its depth z of each other, and half-way between them within floor + quad z^2 [m] of it.
// By pairs, so that a slanted surface stays where it is; 0 stays 0.
void smooth_depth(const DepthImage& depth, float step, float floor, float quad, std::span<float> out);

struct Pinhole {
  double fx = 1.0, fy = 1.0, cx = 0.0, cy = 0.0;  // [px]
};

// out (H, W, 3): unit normals towards the camera by central differences; zero where one of the four neighbours is missing
// or more than 5 % of the depth away.
void normals_of(const DepthImage& depth, const Pinhole& camera, std::span<float> out);

}  // namespace splatbot
