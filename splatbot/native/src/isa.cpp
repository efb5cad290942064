// SPDX-License-Identifier: Apache-2.0
#include "splatbot/isa.hpp"

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <iterator>
#include <stdexcept>

#include "splatbot/isas.hpp"
#include "splatbot/kernels.hpp"

namespace splatbot {

namespace {

#define SPLATBOT_KERNELS_OF(isa) &isa::kKernels,
const Kernels* const kBuilt[] = {SPLATBOT_EACH_ISA(SPLATBOT_KERNELS_OF)};

std::vector<const Kernels*> runnable() {
  std::vector<const Kernels*> found;
  std::copy_if(std::begin(kBuilt), std::end(kBuilt), std::back_inserter(found),
               [](const Kernels* kernels) { return cpu_runs(kernels->name); });
  return found;
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
