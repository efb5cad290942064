// SPDX-License-Identifier: Apache-2.0
#include "splatbot/memory.hpp"

#include <cstdlib>
#include <string_view>

#if defined(__GLIBC__)
#include <malloc.h>
#endif

namespace splatbot {

void keep_freed_memory() {
#if defined(__GLIBC__)
  const char* choice = std::getenv("SPLATBOT_MALLOC");
  if (choice != nullptr && std::string_view(choice) == "system") {
    return;
  }
  constexpr int kLargestKept = 32 << 20;  // the most that glibc accepts
  mallopt(M_MMAP_THRESHOLD, kLargestKept);
  mallopt(M_TRIM_THRESHOLD, 2 * kLargestKept);
#endif
}

}  // namespace splatbot
