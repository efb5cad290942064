// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace splatbot {

// Returns the floating-point operations a second [GFLOP/s] of independent multiply-adds, two operations each. It runs the
// kernels in use on all threads of the pool for about `milliseconds`, and takes the best of ten repetitions.
double multiply_add_peak(double milliseconds);

}  // namespace splatbot
