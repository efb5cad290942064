// SPDX-License-Identifier: Apache-2.0
#include "splatbot/loss.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "splatbot/buffer.hpp"
#include "splatbot/kernels.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {

namespace {

// Large enough that the windows across tiles' borders cost little, small enough for the rings to stay in L2.
constexpr int kTileElements = 768;
constexpr int kTileRows = 64;
constexpr int kMostChannels = 256;
constexpr double kSigma = 1.5;

void require(bool ok, const char* what) {
  if (!ok) {
    throw std::invalid_argument(what);
  }
}

void check(const LossImages& images, std::span<float> gradient) {
  require(images.width > 0 && images.height > 0 && images.channels > 0, "an image is empty");
  require(images.channels <= kMostChannels, "an image has more than 256 channels");
  const std::size_t pixels =
      images.count * static_cast<std::size_t>(images.width) * static_cast<std::size_t>(images.height);
  const std::size_t size = pixels * static_cast<std::size_t>(images.channels);
  require(images.rendered.size() == size && images.target.size() == size, "an image has a wrong size");
  require(images.mask.empty() || images.mask.size() == pixels, "the mask has a wrong size");
  require(gradient.empty() || gradient.size() == size, "the gradient has a wrong size");
}

int divide_up(int a, int b) { return (a + b - 1) / b; }

struct Counts {
  std::size_t pixels, windows;
};

Counts count(const LossImages& images, int margin) {
  const auto width = static_cast<std::size_t>(images.width), height = static_cast<std::size_t>(images.height);
  const auto m = static_cast<std::size_t>(margin);
  if (images.mask.empty()) {
    const std::size_t inner = 2 * m < std::min(width, height) ? (width - 2 * m) * (height - 2 * m) : 0;
    return {images.count * width * height, images.count * inner};
  }
  Counts counts{0, 0};
  for (std::size_t row = 0; row < images.count * height; ++row) {
    const std::uint8_t* mask = images.mask.data() + row * width;
    const bool inner_row = row % height >= m && row % height + m < height;
    for (std::size_t x = 0; x < width; ++x) {
      const std::size_t in = mask[x] != 0 ? 1 : 0;
      counts.pixels += in;
      counts.windows += inner_row && x >= m && x + m < width ? in : 0;
    }
  }
  return counts;
}

LossArgs loss_args(const LossImages& images, std::span<float> gradient) {
  const int most = std::max(1, kTileElements / images.channels);
  LossArgs args{};
  args.width = images.width;
  args.height = images.height;
  args.channels = images.channels;
  args.rendered = images.rendered.data();
  args.target = images.target.data();
  args.mask = images.mask.empty() ? nullptr : images.mask.data();
  args.columns = divide_up(images.width, most);
  args.rows = divide_up(images.height, kTileRows);
  args.tile_width = divide_up(images.width, args.columns);
  args.tile_height = divide_up(images.height, args.rows);
  args.columns = divide_up(images.width, args.tile_width);  // no tile without pixels
  args.rows = divide_up(images.height, args.tile_height);
  const int row = (args.tile_width + 4 * kWindowReach) * images.channels;
  // An odd number of cache lines: rows of a ring must not fall into the same few sets of the cache.
  args.stride = (divide_up(row + 2 * kWindowReach * images.channels + 32, 16) | 1) * 16;
  args.gradient = gradient.empty() ? nullptr : gradient.data();
  double weights[kWindow], sum = 0.0;
  for (int k = 0; k < kWindow; ++k) {
    const double d = (k - kWindowReach) / kSigma;
    sum += weights[k] = std::exp(-0.5 * d * d);
  }
  for (int k = 0; k < kWindow; ++k) {
    args.window[k] = static_cast<float>(weights[k] / sum);
  }
  return args;
}

float* scratch(const LossArgs& args) {
  static thread_local Buffer<float> instance;
  instance.resize(static_cast<std::size_t>(kLossLines) *
                  static_cast<std::size_t>(args.stride));
  return instance.data();
}

}  // namespace

double l1_dssim(const LossImages& images, const LossOptions& options, std::span<float> gradient) {
  check(images, gradient);
  LossArgs args = loss_args(images, gradient);
  args.margin = options.inside_only ? kWindowReach : 0;
  const Counts counts = count(images, args.margin);
  const double channels = images.channels;
  const double per_pixel =
      counts.pixels > 0 ? (1.0 - options.dssim_weight) / (static_cast<double>(counts.pixels) * channels) : 0.0;
  const double per_window =
      counts.windows > 0 ? options.dssim_weight / (static_cast<double>(counts.windows) * channels) : 0.0;
  args.l1_scale = static_cast<float>(per_pixel);
  args.ssim_scale = static_cast<float>(-per_window);
  std::vector<LossSums> sums(images.count * static_cast<std::size_t>(args.columns) *
                             static_cast<std::size_t>(args.rows));
  const Kernels& k = kernels();
  thread_pool()->run(sums.size(), [&](std::size_t tile) { k.loss(args, tile, scratch(args), sums[tile]); });
  double l1 = 0.0, ssim = 0.0;
  for (const LossSums& tile : sums) {
    l1 += tile.l1;
    ssim += tile.ssim;
  }
  const double dssim = counts.windows > 0 ? options.dssim_weight - per_window * ssim : 0.0;
  return per_pixel * l1 + dssim;
}

}  // namespace splatbot
