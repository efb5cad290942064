// SPDX-License-Identifier: Apache-2.0
// Operations of tracking on depth images [m], in which 0 is a missing value.
#pragma once

#include <span>

namespace splatbot {

struct DepthImage {
  int width = 0, height = 0;
  std::span<const float> z;  // (H, W)
};

// out (H, W): z within [near, far] that is not a flying pixel between two surfaces, else 0. A flying pixel is nearer
// than one neighbour and farther than the opposite one by more than `step` of its depth. A missing neighbour does not
// reject a pixel.
void valid_depth(const DepthImage& depth, float near, float far, float step, std::span<float> out);

// out (H / 2, W / 2): the mean over each 2x2 block's pixels within 5 % of its nearest one; 0 where none is measured.
void halve_depth(const DepthImage& depth, std::span<float> out);

// out (N,): median of the measured pixels among the 5x5 around each of the pixels (N, 2). NaN without a measurement,
// or where they span more than 5 % of it (two surfaces).
void depth_around(const DepthImage& depth, std::span<const float> pixels, std::span<double> out);

// out (H, W): gray (H, W), NaN where surfaces of different depth meet. Inverse depth is linear along a plane of any
// slant. A pixel is removed if it bends between
// opposite neighbours by more than `step` of its depth z and floor + quad z^2 [m].
void gray_of_one_surface(const DepthImage& depth, std::span<const float> gray, float step, float floor, float quad,
                         std::span<float> out);

// out (H, W): the mean of each measured pixel and of the opposite pairs in its 3x3 that belong to its surface. In
// such a pair both are measured and within `step` of its depth z of each other. Their mean is within floor + quad z^2
// [m] of z. Pairs keep a slanted surface in place; 0 stays 0.
void smooth_depth(const DepthImage& depth, float step, float floor, float quad, std::span<float> out);

struct Pinhole {
  double fx = 1.0, fy = 1.0, cx = 0.0, cy = 0.0;  // [px]
};

// out (H, W, 3): unit normals towards the camera by central differences. Zero where one of the four neighbours is
// missing or differs by more than 5 % of the depth.
void normals_of(const DepthImage& depth, const Pinhole& camera, std::span<float> out);

}  // namespace splatbot
