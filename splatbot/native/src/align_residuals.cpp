// SPDX-License-Identifier: Apache-2.0
#include "splatbot/align_residuals.hpp"

#include <algorithm>
#include <cmath>

#include "splatbot/kernels.hpp"

namespace splatbot {
namespace {

constexpr int kExposureSteps = 2;

}  // namespace

AlignSums linearize_alignment(const AlignImage& image, const AlignPoints& reference, std::span<const double, 16> T,
                              double gain, double offset, const AlignSettings& settings,
                              std::span<float> residual_photometric, std::span<float> residual_geometric) {
  const auto f = [](double value) { return static_cast<float>(value); };
  LinearizeSums sums{};
  LinearizeArgs args{.width = image.width,
                     .height = image.height,
                     .fx = f(image.fx),
                     .fy = f(image.fy),
                     .cx = f(image.cx),
                     .cy = f(image.cy),
                     .gray = image.gray.data(),
                     .depth = image.depth.data(),
                     .count = 0,
                     .points = nullptr,
                     .normals = nullptr,
                     .gray_reference = nullptr,
                     .T = {},
                     .gain = f(gain),
                     .offset = f(offset),
                     .use_photometric = settings.use_photometric,
                     .use_geometric = settings.use_geometric,
                     .sigma_gray = f(settings.sigma_gray),
                     .sigma_depth_floor = f(settings.sigma_depth_floor),
                     .sigma_depth_quad = f(settings.sigma_depth_quad),
                     .gate = f(settings.gate),
                     .nu = f(settings.nu),
                     .blurred = std::ranges::any_of(settings.blur, [](double value) { return value != 0.0; }),
                     .blur = {},
                     .residual_photometric = nullptr,
                     .residual_geometric = nullptr};
  std::transform(T.begin(), T.begin() + 12, args.T, f);
  std::ranges::transform(settings.blur, args.blur, f);
  std::fill(residual_photometric.begin(), residual_photometric.end(), std::nanf(""));
  std::fill(residual_geometric.begin(), residual_geometric.end(), std::nanf(""));
  const std::size_t n = reference.gray.size();
  for (std::size_t first = 0; first < n; first += kLinearizeChunk) {
    args.count = static_cast<int>(std::min<std::size_t>(kLinearizeChunk, n - first));
    args.points = reference.points.data() + 3 * first;
    args.normals = reference.normals.data() + 3 * first;
    args.gray_reference = reference.gray.data() + first;
    args.residual_photometric = residual_photometric.empty() ? nullptr : residual_photometric.data() + first;
    args.residual_geometric = residual_geometric.empty() ? nullptr : residual_geometric.data() + first;
    kernels().linearize(args, sums);
  }
  AlignSums out;
  for (int i = 0; i < 8; ++i) {
    for (int j = 0; j < 8; ++j) out.H[8 * i + j] = sums.H[8 * std::min(i, j) + std::max(i, j)];
    out.g[i] = sums.g[i];
  }
  out.cost = sums.cost;
  out.projected = sums.projected;
  out.photometric = sums.photometric;
  out.geometric = sums.geometric;
  return out;
}

std::array<double, 3> exposure_inverse(const AlignSums& sums) {
  const double A00 = sums.H[54] + kExposurePrior, A01 = sums.H[55], A11 = sums.H[63] + kExposurePrior;
  const double det = A00 * A11 - A01 * A01;
  return {A11 / det, -A01 / det, A00 / det};
}

std::array<double, 2> align_residuals(const AlignImage& image, const AlignPoints& reference,
                                      std::span<const double, 16> T, const AlignSettings& settings,
                                      std::span<float> residual_photometric, std::span<float> residual_geometric) {
  double gain = 1.0, offset = 0.0;
  for (int step = 0; step < kExposureSteps; ++step) {
    const AlignSums s = linearize_alignment(image, reference, T, gain, offset, settings, {}, {});
    const std::array<double, 3> inverse = exposure_inverse(s);
    gain -= inverse[0] * s.g[6] + inverse[1] * s.g[7];
    offset -= inverse[1] * s.g[6] + inverse[2] * s.g[7];
  }
  linearize_alignment(image, reference, T, gain, offset, settings, residual_photometric, residual_geometric);
  return {gain, offset};
}

}  // namespace splatbot
