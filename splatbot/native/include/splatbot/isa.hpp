// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>
#include <vector>

namespace splatbot {

// The kernels in use: "v2" (SSE4.2), "v3" (AVX2, FMA), "v4" (AVX-512) of x86-64, or "baseline" elsewhere. The best the
// CPU runs, unless SPLATBOT_ISA names another. Throws std::runtime_error where that one cannot run here.
std::string_view isa();

// The kernels that this CPU can run, the simplest first.
std::vector<std::string> available_isas();

// Changes the kernels; an empty name returns to the default. Throws std::runtime_error for one that cannot run here.
void set_isa(std::string_view name);

}  // namespace splatbot
