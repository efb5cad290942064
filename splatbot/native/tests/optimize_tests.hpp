// SPDX-License-Identifier: Apache-2.0
#pragma once

// The loss and Adam on images and rows of awkward sizes, on the kernels in use; exits 1 at a broken promise.
void run_optimize();
