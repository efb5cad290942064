// SPDX-License-Identifier: Apache-2.0
#include "optimize_tests.hpp"

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <limits>
#include <cstdlib>
#include <random>
#include <vector>

#include "promises.hpp"
#include "splatbot/adam.hpp"
#include "splatbot/isa.hpp"
#include "splatbot/loss.hpp"
#include "splatbot/threads.hpp"

namespace {

using namespace splatbot;

struct Images {
  std::vector<float> rendered, target;
  std::vector<std::uint8_t> mask;

  Images(std::size_t pixels, int channels, bool masked) {
    std::mt19937 random(11);
    std::uniform_real_distribution<float> uniform(0.0F, 1.0F);
    for (std::size_t i = 0; i < pixels * static_cast<std::size_t>(channels); ++i) {
      target.push_back(uniform(random));
      rendered.push_back(0.8F * target.back() + 0.2F * uniform(random));
    }
    for (std::size_t i = 0; masked && i < pixels; ++i) {
      mask.push_back(i % 3 != 0 ? 1 : 0);
    }
  }
};

void run_loss(int width, int height, int channels, bool masked, bool inside_only) {
  const std::size_t count = 2;
  const Images data(count * static_cast<std::size_t>(width) * static_cast<std::size_t>(height), channels, masked);
  const LossImages images = {.count = count,
                             .width = width,
                             .height = height,
                             .channels = channels,
                             .rendered = data.rendered,
                             .target = data.target,
                             .mask = data.mask};
  const LossOptions options = {.inside_only = inside_only};
  std::vector<float> gradient(data.rendered.size()), again(data.rendered.size());
  set_num_threads(1);
  const double value = l1_dssim(images, options, gradient);
  promise(std::isfinite(value) && value >= -1e-6 && value < 1.0, "the loss of images in 0..1 lies in 0..1");
  for (const unsigned threads : {2U, 8U}) {
    set_num_threads(threads);
    promise(l1_dssim(images, options, again) == value && again == gradient, "threads change no bit of loss or gradient");
    promise(std::fabs(l1_dssim(images, options, {}) - value) < 1e-6, "the value is the same without a gradient");
  }
  // Along the gradient the loss falls as the gradient says.
  std::vector<float> moved = data.rendered;
  double norm2 = 0.0;
  for (const float g : gradient) {
    norm2 += static_cast<double>(g) * static_cast<double>(g);
  }
  const double step = 1e-4 / std::sqrt(norm2 + 1e-30);
  for (std::size_t i = 0; i < moved.size(); ++i) {
    moved[i] -= static_cast<float>(step) * gradient[i];
  }
  LossImages after = images;
  after.rendered = moved;
  promise(l1_dssim(after, options, {}) <= value, "a step against the gradient does not raise the loss");
}

void run_adam(std::size_t rows, std::size_t columns) {
  std::vector<float> values(rows * columns, 1.0F), first(values.size()), second(values.size()), gradient(values.size());
  std::vector<float> steps(rows);
  std::vector<std::uint8_t> chosen(rows);
  for (std::size_t i = 0; i < gradient.size(); ++i) {
    gradient[i] = static_cast<float>(i % 5) - 2.0F;
  }
  for (std::size_t i = 0; i < rows; ++i) {
    chosen[i] = i % 4 != 1 ? 1 : 0;
  }
  std::size_t spoilt = 0;
  for (std::size_t i = 0; i < rows; i += 7) {
    gradient[i * columns + i % columns] = i % 2 == 0 ? std::numeric_limits<float>::quiet_NaN() : INFINITY;
    spoilt += chosen[i];
    chosen[i] = chosen[i] != 0 ? 2 : 0;
  }
  const std::vector<float> rates(rows % 2 == 0 ? 1 : columns, 0.5F);  // one, or one for each column
  const AdamParameter parameter = {values, first, second, gradient, rates};
  promise(adam_step(std::span(&parameter, 1), chosen, steps, {.eps = 1e-12}) == spoilt, "spoilt gradients are counted");
  for (std::size_t i = 0; i < values.size(); ++i) {
    const bool on = chosen[i / columns] == 1;
    const float sign = gradient[i] > 0.0F ? 1.0F : gradient[i] < 0.0F ? -1.0F : 0.0F;
    promise(std::fabs(values[i] - (on ? 1.0F - 0.5F * sign : 1.0F)) < 1e-5F, "Adam's first step is the rate, chosen rows only");
    promise(on || (first[i] == 0.0F && second[i] == 0.0F), "rows that are not chosen keep their moments");
  }
}

}  // namespace

void run_optimize() {
  int losses = 0;
  for (const auto& [width, height] : {std::pair{1, 1}, {7, 5}, {11, 11}, {300, 3}, {3, 140}, {270, 80}}) {
    for (const int channels : {1, 3, 7}) {
      for (const bool masked : {false, true}) {
        run_loss(width, height, channels, masked, false);
        losses += 1;
        if (width >= 11 && height >= 11) {
          run_loss(width, height, channels, masked, true);
          losses += 1;
        }
      }
    }
  }
  for (const std::size_t rows : {0U, 1U, 17U, 1024U, 2500U}) {
    for (const std::size_t columns : {1U, 3U, 4U, 48U}) {
      run_adam(rows, columns);
    }
  }
  std::printf("%.*s: %d losses and their gradients, Adam\n", static_cast<int>(isa().size()), isa().data(), losses);
}
