// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/planner.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "splatbot/planning/shortcut.hpp"

#include <cstdlib>

namespace splatbot::planning {

namespace {
constexpr double kInfinity = std::numeric_limits<double>::infinity();
double knob(const char* name, double value) { const char* t = std::getenv(name); return t ? std::atof(t) : value; }
}  // namespace

Planner::Planner(std::shared_ptr<Space> space) : space_(std::move(space)) {}

BestPath Planner::best() const {
  const std::lock_guard lock(mutex_);
  return best_;
}

void Planner::publish(double seconds) {
  const std::lock_guard lock(mutex_);
  best_.waypoints = star_->path();
  best_.cost = star_->best();
  best_.history.push_back({seconds, best_.cost});
}

PlanEnd Planner::run(std::span<const double> start, std::span<const double> goals, const PlanLimits& limits) {
  const Stop stop(limits.seconds, &cancelled_);
  const double kRange = knob("P_RANGE", 1.5);
  random_ = Random(limits.seed);
  sampler_ = std::make_unique<Sampler>(*space_, start, goals);
  star_ = std::make_unique<Star>(*space_, *sampler_, start, knob("P_STAR_RANGE", 2.0));
  connect_ = std::make_unique<Connect>(*space_, *sampler_, kRange);
  edges_before_ = space_->edges();
  {
    const std::lock_guard lock(mutex_);
    best_ = {{}, kInfinity, {}};
  }
  std::uint64_t left = limits.iterations;
  const bool met = connect_->run(start, random_, stop, kInfinity, left);
  iterations_ = limits.iterations - left;
  if (met) {
    star_->adopt(*connect_);
    publish(stop.elapsed());
    improve(start, limits, stop);
    cancelled_.store(false);
    return PlanEnd::improved;
  }
  const bool cancelled = cancelled_.exchange(false);
  return cancelled ? PlanEnd::cancelled : left == 0 ? PlanEnd::exhausted : PlanEnd::timed_out;
}

void Planner::shorten(const Configuration& path, int attempts, const Stop& stop) {
  if (path.size() < 3 * space_->size()) {
    return;  // a straight line
  }
  Shortcut shortcut(*space_, path);
  shortcut.leave_out();
  int idle = 0;
  for (int i = 0; i < attempts && idle < knob("P_IDLE", 30) && !stop.now(); ++i) {
    idle = shortcut.improve(random_) ? 0 : idle + 1;
  }
  shortcut.leave_out();
  if (star_->insert(shortcut.waypoints())) {
    publish(stop.elapsed());
  }
}

void Planner::improve(std::span<const double> start, const PlanLimits& limits, const Stop& stop) {
  Configuration q(space_->size());
  shorten(star_->path(), static_cast<int>(knob("P_SHORT0", 100)), stop);
  const double p_local = knob("P_LOCAL", 0.3);
  const int every = static_cast<int>(knob("P_RESTART", 20));
  const int attempts = static_cast<int>(knob("P_SHORT", 60));
  std::size_t pruned = 1000;
  int round = 0;
  while (iterations_ < limits.iterations && !stop.now() && star_->best() > limits.good_enough) {
    ++iterations_;
    ++round;
    if (every > 0 && round % every == 0) {
      std::uint64_t left = static_cast<std::uint64_t>(knob("P_RITER", 200));
      if (connect_->run(start, random_, stop, star_->best() * knob("P_BOUND", 1.3), left)) {
        shorten(connect_->path(), attempts, stop);
      }
      continue;
    }
    if (every > 0 && round % every == every / 2) {
      shorten(star_->path(), attempts, stop);
      continue;
    }
    const bool sampled = random_.uniform() < p_local ? local(q.data()) : sampler_->informed(random_, star_->best(), q.data());
    if (sampled && star_->grow(q.data(), stop)) {
      publish(stop.elapsed());
    }
    if (star_->tree().size() > 2 * pruned) {
      star_->prune();
      pruned = std::max<std::size_t>(1000, star_->tree().size());
    }
  }
}

// Near the best path. False: out of limits.
bool Planner::local(double* q) {
  const Configuration path = star_->path();
  const std::size_t dims = space_->size(), edges = path.size() / dims - 1;
  const std::size_t edge = random_.below(edges);
  const double t = random_.uniform();
  const double spread = 0.3 * std::exp(-3.0 * random_.uniform());
  for (std::size_t d = 0; d < dims; ++d) {
    const double a = path[edge * dims + d], b = path[(edge + 1) * dims + d];
    q[d] = a + t * (b - a) + spread * random_.normal();
  }
  return space_->contains(q);
}

}  // namespace splatbot::planning
