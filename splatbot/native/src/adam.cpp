// SPDX-License-Identifier: Apache-2.0
#include "splatbot/adam.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "splatbot/buffer.hpp"
#include "splatbot/kernels.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {

namespace {

constexpr std::size_t kRows = 1024;  // a block's scales stay in L1

void require(bool ok, const char* what) {
  if (!ok) {
    throw std::invalid_argument(what);
  }
}

std::vector<AdamGroup> groups_of(std::span<const AdamParameter> parameters, std::size_t rows) {
  std::vector<AdamGroup> groups;
  for (const AdamParameter& p : parameters) {
    const std::size_t size = p.values.size();
    require(rows == 0 ? size == 0 : size % rows == 0, "a parameter has another number of rows");
    require(p.first.size() == size && p.second.size() == size && p.gradient.size() == size,
            "a parameter, its gradient and its moments differ in size");
    if (size == 0) {
      continue;
    }
    const std::size_t columns = size / rows;
    const bool one = p.rates.size() == 1;
    require(one || p.rates.size() == columns, "a parameter has neither one rate nor one for each column");
    groups.push_back({p.values.data(), p.first.data(), p.second.data(), p.gradient.data(), columns,
                      one ? p.rates[0] : 1.0F, one ? nullptr : p.rates.data()});
  }
  return groups;
}

// Corrections of the moments' bias by number of steps; most rows share few numbers, and a power costs more than a step.
class Corrections {
 public:
  Corrections(const AdamOptions& options, std::span<const float> steps) : options_(options) {
    float most = 0.0F;
    for (const float t : steps) {
      most = std::max(most, t);
    }
    table_.reserve(kTabulated);
    const std::size_t n = std::min<std::size_t>(kTabulated, static_cast<std::size_t>(std::min(most, 1e6F)) + 2);
    for (std::size_t t = 0; t < n; ++t) {
      table_.push_back(compute(static_cast<double>(t)));
    }
  }

  struct Pair {
    float step_scale, eps;
  };

  Pair at(float steps) const {
    const auto t = static_cast<std::size_t>(steps);
    return t < table_.size() ? table_[t] : compute(static_cast<double>(steps));
  }

 private:
  static constexpr std::size_t kTabulated = 4096;

  Pair compute(double t) const {
    const double root = std::sqrt(1.0 - std::pow(options_.beta2, t));
    return {static_cast<float>(root / (1.0 - std::pow(options_.beta1, std::max(t, 1.0)))),
            static_cast<float>(options_.eps * root)};
  }

  AdamOptions options_;
  std::vector<Pair> table_;
};

struct Scratch {
  Buffer<float> scales, eps, spread;
};

Scratch& scratch(std::size_t widest) {
  static thread_local Scratch instance;
  instance.scales.resize(kRows);
  instance.eps.resize(kRows);
  instance.spread.resize(2 * (kRows * widest + 64));
  return instance;
}

// True if a row's gradients are all finite: 0 times any other value is NaN.
bool is_finite(const std::vector<AdamGroup>& groups, std::size_t row) {
  float sum = 0.0F;
  for (const AdamGroup& group : groups) {
    const float* const g = group.gradient + row * group.columns;
    for (std::size_t c = 0; c < group.columns; ++c) {
      sum += 0.0F * g[c];
    }
  }
  return sum == 0.0F;
}

}  // namespace

std::size_t adam_step(std::span<const AdamParameter> parameters, std::span<const std::uint8_t> chosen,
                      std::span<float> steps, const AdamOptions& options) {
  const std::size_t rows = steps.size();
  require(chosen.size() == rows, "the chosen rows and the step counts differ in number");
  const std::vector<AdamGroup> groups = groups_of(parameters, rows);
  std::size_t widest = 1;
  for (const AdamGroup& group : groups) {
    widest = std::max(widest, group.columns);
  }
  const Corrections corrections(options, steps);
  const Kernels& k = kernels();
  std::atomic<std::size_t> skipped{0};
  thread_pool()->run((rows + kRows - 1) / kRows, [&](std::size_t b) {
    Scratch& s = scratch(widest);
    AdamBlock block{b * kRows,
                    std::min(kRows, rows - b * kRows),
                    s.scales.data(),
                    s.eps.data(),
                    static_cast<float>(options.beta1),
                    static_cast<float>(options.beta2),
                    s.spread.data()};
    bool any = false;
    for (std::size_t i = 0; i < block.count; ++i) {
      const std::size_t row = block.begin + i;
      const bool on = chosen[row] != 0 && is_finite(groups, row);
      if (!on && chosen[row] != 0) {
        ++skipped;
      }
      steps[row] += on ? 1.0F : 0.0F;
      const Corrections::Pair pair = on ? corrections.at(steps[row]) : Corrections::Pair{0.0F, 1.0F};
      s.scales[i] = pair.step_scale;
      s.eps[i] = pair.eps;
      any |= on;
    }
    for (const AdamGroup& group : groups) {
      if (any) {
        k.adam(group, block);
      }
    }
  });
  return skipped;
}

}  // namespace splatbot
