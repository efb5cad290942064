// SPDX-License-Identifier: Apache-2.0
#include "splatbot/isa.hpp"

#include <atomic>
#include <cstdlib>
#include <stdexcept>

#include "splatbot/kernels.hpp"

namespace splatbot {

namespace {

std::vector<const Kernels*> runnable() {
#if defined(SPLATBOT_X86)
  __builtin_cpu_init();
  const bool level2 = __builtin_cpu_supports("sse4.2") && __builtin_cpu_supports("popcnt");
  const bool level3 = level2 && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                      __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2");
  const bool level4 = level3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                      __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
                      __builtin_cpu_supports("avx512vl");
  std::vector<const Kernels*> found;
  const auto add_if = [&found](bool runs, const Kernels& kernels) {
    if (runs) {
      found.push_back(&kernels);
    }
  };
#if defined(SPLATBOT_HAS_v2)
  add_if(level2, v2::kKernels);
#endif
#if defined(SPLATBOT_HAS_v3)
  add_if(level3, v3::kKernels);
#endif
#if defined(SPLATBOT_HAS_v4)
  add_if(level4, v4::kKernels);
#endif
  return found;
#else
  return {&baseline::kKernels};
#endif
}

const Kernels& choose(std::string_view name) {
  const std::vector<const Kernels*> found = runnable();
  if (found.empty()) {
    throw std::runtime_error("this CPU runs none of the kernels that were built; they need SSE4.2 and POPCNT (x86-64-v2) at least");
  }
  if (name.empty()) {
    return *found.back();
  }
  std::string names;
  for (const Kernels* kernels : found) {
    if (name == kernels->name) {
      return *kernels;
    }
    names += (names.empty() ? "" : ", ") + std::string(kernels->name);
  }
  throw std::runtime_error("kernels '" + std::string(name) + "' cannot run here; this CPU runs: " + names);
}

std::atomic<const Kernels*>& chosen() {
  static std::atomic<const Kernels*> instance{nullptr};
  return instance;
}

const Kernels& choose_default() {
  const char* name = std::getenv("SPLATBOT_ISA");
  return choose(name == nullptr ? "" : name);
}

}  // namespace

const Kernels& kernels() {
  const Kernels* current = chosen().load();
  if (current == nullptr) {
    current = &choose_default();
    chosen().store(current);
  }
  return *current;
}

std::string_view isa() { return kernels().name; }

std::vector<std::string> available_isas() {
  std::vector<std::string> names;
  for (const Kernels* kernels : runnable()) {
    names.emplace_back(kernels->name);
  }
  return names;
}

void set_isa(std::string_view name) { chosen().store(name.empty() ? &choose_default() : &choose(name)); }

}  // namespace splatbot
