// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string_view>

namespace splatbot {

// Returns the floating-point operations a second [GFLOP/s] of independent multiply-adds, two operations each. It runs
// them with one instruction set on that many threads for about `milliseconds`, and takes the best of ten repetitions.
// Throws std::invalid_argument if the instruction set cannot run here, or for no threads.
double multiply_add_peak(std::string_view isa, unsigned threads, double milliseconds);

}  // namespace splatbot
