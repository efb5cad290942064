// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

namespace splatbot {

// Images (count, height, width, channels), contiguous.
struct LossImages {
  std::size_t count = 0;
  int width = 0, height = 0, channels = 0;
  std::span<const float> rendered, target;
  std::span<const std::uint8_t> mask;  // (count, height, width), 0 leaves a pixel out; may be empty
};

struct LossOptions {
  double dssim_weight = 0.2;
  bool inside_only = false;  // only windows that lie inside the image count
};

// (1 - w) mean|x - y| + w (1 - mean SSIM(x, y)) with w = dssim_weight, over pixels and channels of all images. Its
// gradient goes to `rendered`, unless `gradient` is empty.
//
// SSIM (Wang et al. 2004, equation 13) of values in 0..1 with a Gaussian window of 11x11 pixels, sigma 1.5. Outside
// the image, both images are 0. Under a mask, both means are over its pixels. Outside the mask the rendered image
// equals the target, so that a window across the border compares the inside alone. An empty mask gives 0.
//
// Not finite if a value (under the mask, of `rendered`; anywhere, of `target`) is not finite or above 1e18. The
// result does not depend on the number of threads. Throws std::invalid_argument if sizes do not fit.
double l1_dssim(const LossImages& images, const LossOptions& options, std::span<float> gradient);

}  // namespace splatbot
