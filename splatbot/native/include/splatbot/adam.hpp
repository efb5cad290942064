// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

namespace splatbot {

// One kind of parameter: (rows, columns) values, their gradient and moments, and its learning rate: one, or one for each
// column.
struct AdamParameter {
  std::span<float> values, first, second;
  std::span<const float> gradient;
  std::span<const float> rates;
};

struct AdamOptions {
  double beta1 = 0.9, beta2 = 0.999, eps = 1e-8;
};

// One step of Adam (Kingma & Ba 2015, algorithm 1) of the rows that `chosen` marks, in place; the others keep their
// bits. `steps` counts each row's own steps, this one included afterwards. Rows are independent, so the result does
// not depend on the number of threads. A chosen row with a gradient that is not finite is left alone as well; returns the
// number of those. Throws std::invalid_argument if sizes do not fit.
std::size_t adam_step(std::span<const AdamParameter> parameters, std::span<const std::uint8_t> chosen,
                      std::span<float> steps, const AdamOptions& options);

}  // namespace splatbot
