// SPDX-License-Identifier: Apache-2.0
// Code that the rasterizers' backward passes share outside the kernels.
#pragma once

#include <array>
#include <span>

#include "splatbot/kernels.hpp"

namespace splatbot {

template <class T>
T* pointer(std::span<T> span) {
  return span.empty() ? nullptr : span.data();
}

// Sums of a camera's gradient: about the view's origin, and to the camera's centre.
struct CameraGradient {
  std::array<double, kCameraSums> sums{};
  std::array<double, 3> center{};

  void add_sums(std::span<const double> blocks);  // (blocks, kCameraSums)
};

// The camera sees R (x - origin) + translation = R x + t, and its centre is -R^-1 t.
void add_camera_gradient(const View& view, const CameraGradient& from, std::span<double> out);

// d render / d background is the transmittance left: the first of the `planes` that a blend keeps of a tile's pixels.
void add_background_gradient(const TileLists& lists, const View& view, const float* final_state, int planes,
                             std::span<const float> grad_colors, std::span<double> out);

// True if the gradient to the colours goes on into harmonics: from degree 1 on, they depend on the positions of the
// Gaussian and the camera.
bool wants_harmonics(const Gaussians& gaussians, const Gradients& out);

// From the gradient to the colours (N, 3) to those of coefficients, means and the camera's centre.
void pull_back_harmonics(const HarmonicsArgs& forward, std::size_t blocks, const float* colors, const Gradients& out,
                         Buffer<double>& scratch, CameraGradient& camera);

}  // namespace splatbot
