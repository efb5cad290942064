// SPDX-License-Identifier: Apache-2.0
#include "splatbot/peak.hpp"

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <vector>

#include "splatbot/kernels.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {

namespace {

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

}  // namespace

double multiply_add_peak(double milliseconds) {
  constexpr int kStretches = 10;
  constexpr std::size_t kShares = 16;  // tasks to a thread, so that a late one costs little
  const Kernels& k = kernels();
  const auto pool = thread_pool();
  std::size_t rounds = 1000;
  std::vector<float> keep(pool->size() * kShares);
  const auto stretch = [&] {
    const Clock::time_point start = Clock::now();
    pool->run(keep.size(), [&](std::size_t i) { keep[i] = k.multiply_add(rounds); });
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
  const double flops = static_cast<double>(kMultiplyAddFlops) * k.lanes * static_cast<double>(rounds * keep.size());
  return 1e-9 * flops / best;
}

}  // namespace splatbot
