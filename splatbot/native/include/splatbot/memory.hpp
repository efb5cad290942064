// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace splatbot {

// Lets the C library keep up to 64 MiB of freed memory for the next allocation, which is where its own limits end up after
// a few large arrays; until then, images and gradients would be given back to the system after each call and faulted in
// again page by page, at the price of a quarter of a small render. Does nothing where SPLATBOT_MALLOC is "system", or the
// C library is not glibc.
void keep_freed_memory();

}  // namespace splatbot
