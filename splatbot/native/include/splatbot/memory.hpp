// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace splatbot {

// Lets the C library keep up to 64 MiB of freed memory for the next allocation; its own limits reach that after a few
// large arrays. Until then images and gradients would return to the system after each call. Faulting them in again
// costs a quarter of a small render. Does nothing if SPLATBOT_MALLOC is "system", or if the C library is not glibc.
void keep_freed_memory();

}  // namespace splatbot
