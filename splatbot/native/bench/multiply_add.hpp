// SPDX-License-Identifier: Apache-2.0
// The yardstick's kernels, compiled once for each instruction set.
#pragma once

#include <cstddef>

#include "splatbot/isas.hpp"

namespace splatbot {

inline constexpr int kMultiplyAddChains = 12;  // enough to hide the latency of two units
inline constexpr std::size_t kMultiplyAddFlops = 2 * kMultiplyAddChains;

struct MultiplyAdd {
  const char* isa;
  float (*run)(std::size_t rounds);  // kMultiplyAddFlops x lanes x rounds floating-point operations
  int lanes;
};

#define SPLATBOT_DECLARE_MULTIPLY_ADD(isa) \
  namespace isa {                           \
  extern const MultiplyAdd kMultiplyAdd;    \
  }
SPLATBOT_EACH_ISA(SPLATBOT_DECLARE_MULTIPLY_ADD)
#undef SPLATBOT_DECLARE_MULTIPLY_ADD

}  // namespace splatbot
