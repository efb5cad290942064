// SPDX-License-Identifier: Apache-2.0
#include "splatbot/isas.hpp"

namespace splatbot {

bool cpu_runs(std::string_view isa) {
#if defined(SPLATBOT_X86)
  __builtin_cpu_init();
  const bool level2 = __builtin_cpu_supports("sse4.2") && __builtin_cpu_supports("popcnt");
  const bool level3 = level2 && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                      __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2");
  const bool level4 = level3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                      __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
                      __builtin_cpu_supports("avx512vl");
  return (isa == "v2" && level2) || (isa == "v3" && level3) || (isa == "v4" && level4);
#else
  return isa == "baseline";
#endif
}

}  // namespace splatbot
