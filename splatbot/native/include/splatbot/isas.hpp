// SPDX-License-Identifier: Apache-2.0
// The instruction sets that kernels are built for.
#pragma once

#include <string_view>

// SPLATBOT_EACH_ISA(DO) is DO(name) for each of them, the simplest first.
#if defined(SPLATBOT_X86)
#if defined(SPLATBOT_HAS_v2)
#define SPLATBOT_V2(DO) DO(v2)
#else
#define SPLATBOT_V2(DO)
#endif
#if defined(SPLATBOT_HAS_v3)
#define SPLATBOT_V3(DO) DO(v3)
#else
#define SPLATBOT_V3(DO)
#endif
#if defined(SPLATBOT_HAS_v4)
#define SPLATBOT_V4(DO) DO(v4)
#else
#define SPLATBOT_V4(DO)
#endif
#define SPLATBOT_EACH_ISA(DO) SPLATBOT_V2(DO) SPLATBOT_V3(DO) SPLATBOT_V4(DO)
#else
#define SPLATBOT_EACH_ISA(DO) DO(baseline)
#endif

namespace splatbot {

// True if this CPU runs the kernels of that name; "baseline" runs on all.
bool cpu_runs(std::string_view isa);

}  // namespace splatbot
