// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace splatbot {

// Floating-point operations a second [GFLOP/s] of independent multiply-adds (two each) in the kernels in use, on all
// threads of the pool for about `milliseconds`: the best of ten stretches.
double multiply_add_peak(double milliseconds);

}  // namespace splatbot
