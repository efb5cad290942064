// SPDX-License-Identifier: Apache-2.0
// The yardstick of `splatbot bench`: independent multiply-adds in registers, as fast as this instruction set goes.
#include "multiply_add.hpp"

#include "../src/kernels/simd.hpp"

#define SB_TEXT(name) #name
#define SB_EXPANDED_TEXT(name) SB_TEXT(name)

namespace splatbot::SPLATBOT_KERNELS {

namespace {

float multiply_add(std::size_t rounds) {
  F sums[kMultiplyAddChains];
  for (int i = 0; i < kMultiplyAddChains; ++i) {
    sums[i] = set1(1.0F + static_cast<float>(i));
  }
  const F a = set1(0.999F), b = set1(1e-3F);
  for (std::size_t r = 0; r < rounds; ++r) {
#pragma GCC unroll 12
    for (int i = 0; i < kMultiplyAddChains; ++i) {
      sums[i] = fma(sums[i], a, b);
    }
  }
  F all = sums[0];
  for (int i = 1; i < kMultiplyAddChains; ++i) {
    all = all + sums[i];
  }
  alignas(64) float lanes[W];
  store(lanes, all);
  return lanes[0];
}

}  // namespace

const MultiplyAdd kMultiplyAdd = {SB_EXPANDED_TEXT(SPLATBOT_KERNELS), multiply_add, W};

}  // namespace splatbot::SPLATBOT_KERNELS
