// SPDX-License-Identifier: Apache-2.0
#include "peak.hpp"

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <stdexcept>
#include <string>
#include <vector>

#include "multiply_add.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {

namespace {

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

#define SPLATBOT_MULTIPLY_ADD_OF(isa) &isa::kMultiplyAdd,
const MultiplyAdd* const kBuilt[] = {SPLATBOT_EACH_ISA(SPLATBOT_MULTIPLY_ADD_OF)};

const MultiplyAdd& multiply_add_of(std::string_view isa) {
  for (const MultiplyAdd* built : kBuilt) {
    if (isa == built->isa && cpu_runs(isa)) {
      return *built;
    }
  }
  throw std::invalid_argument("kernels '" + std::string(isa) + "' cannot run here");
}

}  // namespace

double multiply_add_peak(std::string_view isa, unsigned threads, double milliseconds) {
  constexpr int kStretches = 10;
  constexpr std::size_t kShares = 16;  // tasks to a thread, so that a late one costs little
  const MultiplyAdd& multiply_add = multiply_add_of(isa);
  if (threads < 1) {
    throw std::invalid_argument("threads is 0, must be at least 1");
  }
  ThreadPool pool(threads);
  std::size_t rounds = 1000;
  std::vector<float> keep(pool.size() * kShares);
  const auto stretch = [&] {
    const Clock::time_point start = Clock::now();
    pool.run(keep.size(), [&](std::size_t i) { keep[i] = multiply_add.run(rounds); });
    return seconds_since(start);
  };
  stretch();  // wakes the threads and the clock
  const double once = stretch();
  rounds = std::max<std::size_t>(1, static_cast<std::size_t>(static_cast<double>(rounds) * 1e-3 * milliseconds /
                                                             (kStretches * std::max(once, 1e-9))));
  double best = stretch();
  for (int i = 1; i < kStretches; ++i) {
    best = std::min(best, stretch());
  }
  const double flops = static_cast<double>(kMultiplyAddFlops) * multiply_add.lanes * static_cast<double>(rounds * keep.size());
  return 1e-9 * flops / best;
}

}  // namespace splatbot
