// SPDX-License-Identifier: Apache-2.0
#include "entry.hpp"
#include "simd.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

// Each row's value once for each of its columns.
void spread(const float* values, std::size_t rows, std::size_t columns, float* out) {
  if (columns == 3) {
    for (std::size_t r = 0; r < rows; ++r) {
      out[3 * r] = out[3 * r + 1] = out[3 * r + 2] = values[r];
    }
  } else if (columns == 4) {
    for (std::size_t r = 0; r < rows; ++r) {
      out[4 * r] = out[4 * r + 1] = out[4 * r + 2] = out[4 * r + 3] = values[r];
    }
  } else {
    for (std::size_t r = 0; r < rows; ++r) {
      for (std::size_t c = 0; c < columns; ++c) {
        out[r * columns + c] = values[r];
      }
    }
  }
}

// Each row's value times each column's rate.
void spread(const float* values, std::size_t rows, std::size_t columns, const float* rates, float* out) {
  for (std::size_t r = 0; r < rows; ++r) {
    for (std::size_t c = 0; c < columns; ++c) {
      out[r * columns + c] = values[r] * rates[c];
    }
  }
}

struct Elements {
  float *values, *first, *second;
  const float *gradient, *step_scale, *eps;
};

// One vector of elements; those of rows that are left alone keep their bits.
SB_INLINE void step(const Elements& e, std::size_t i, const AdamGroup& group, const AdamBlock& block) {
  const F scale = load(e.step_scale + i);
  const M chosen = scale > set1(0.0F);
  if (bits(chosen) == 0) {
    return;
  }
  const F g = load(e.gradient + i), m0 = load(e.first + i), v0 = load(e.second + i), x = load(e.values + i);
  const F m = fma(set1(block.beta1), m0, set1(1.0F - block.beta1) * g);
  const F v = fma(set1(block.beta2), v0, set1(1.0F - block.beta2) * g * g);
  const F update = scale * m / (sqrt(v) + load(e.eps + i));
  store(e.first + i, select(chosen, m, m0));
  store(e.second + i, select(chosen, v, v0));
  store(e.values + i, select(chosen, fnma(set1(group.rate), update, x), x));
}

}  // namespace

void adam(const AdamGroup& group, const AdamBlock& block) {
  const std::size_t offset = block.begin * group.columns, n = block.count * group.columns;
  float* step_scale = block.scratch;
  float* eps = block.scratch + n + W;
  if (group.column_rates != nullptr) {
    spread(block.step_scale, block.count, group.columns, group.column_rates, step_scale);
  } else {
    spread(block.step_scale, block.count, group.columns, step_scale);
  }
  spread(block.eps, block.count, group.columns, eps);
  const Elements all{group.values + offset, group.first + offset, group.second + offset,
                     group.gradient + offset, step_scale, eps};
  std::size_t i = 0;
  for (; i + W <= n; i += W) {
    step(all, i, group, block);
  }
  if (i == n) {
    return;
  }
  // The last few elements go through a copy: the memory behind them may belong to another block.
  alignas(64) float tail[6][W] = {};
  const std::size_t left = (n - i) * sizeof(float);
  const float* const sources[6] = {all.values + i, all.first + i, all.second + i, all.gradient + i, step_scale + i, eps + i};
  for (int k = 0; k < 6; ++k) {
    std::memcpy(tail[k], sources[k], left);
  }
  step({tail[0], tail[1], tail[2], tail[3], tail[4], tail[5]}, 0, group, block);
  std::memcpy(all.values + i, tail[0], left);
  std::memcpy(all.first + i, tail[1], left);
  std::memcpy(all.second + i, tail[2], left);
}

}  // namespace splatbot::SPLATBOT_KERNELS
