// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/planner.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "splatbot/planning/shortcut.hpp"

namespace splatbot::planning {

namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kConnectRange = 1.5, kRrtStarRange = 2.0;  // [rad] longest new edges
constexpr double kLocalShare = 0.5;                      // of RRT*'s samples that are near the best path
constexpr int kRound = 60;                               // samples between two rounds of shortcuts or restarts
constexpr int kAttempts = 30, kFirstAttempts = 100;      // shortcuts tried in a row
constexpr int kIdle = 30;                                // vain ones before it is left
constexpr std::uint64_t kRestartSamples = 200;
constexpr double kRestartBound = 1.3;  // times the best cost: shortcuts may make the path better than the best
constexpr std::size_t kFewNodes = 1000;

}  // namespace

Planner::Planner(std::shared_ptr<Space> space) : space_(std::move(space)) {}

BestPath Planner::best() const {
  const std::lock_guard lock(mutex_);
  return best_;
}

void Planner::forget_best() {
  const std::lock_guard lock(mutex_);
  best_ = {{}, kInfinity, {}};
}

void Planner::publish(double seconds) { publish(rrt_star_->path(), rrt_star_->best(), seconds); }

void Planner::publish(Configuration waypoints, double cost, double seconds) {
  const std::lock_guard lock(mutex_);
  if (cost < best_.cost) {
    best_.waypoints = std::move(waypoints);
    best_.cost = cost;
    best_.history.push_back({seconds, cost});
  }
}

PlanEnd Planner::run(std::span<const double> start, std::span<const double> goals, const PlanLimits& limits) {
  const Stop stop(limits.seconds, &cancelled_);
  random_ = Random(limits.seed);
  goals_.assign(goals.begin(), goals.end());
  begin(start);
  forget_best();
  return search(limits, stop);
}

// A tree of the start alone.
void Planner::begin(std::span<const double> start) {
  start_.assign(start.begin(), start.end());
  sampler_ = std::make_unique<Sampler>(*space_, start_, goals_);
  rrt_star_ = std::make_unique<RrtStar>(*space_, *sampler_, start_, kRrtStarRange);
  connect_ = std::make_unique<Connect>(*space_, *sampler_, kConnectRange);
  edges_before_ = space_->edges();
  iterations_ = 0;
}

PlanEnd Planner::rerun(std::span<const double> start, Space& added, const PlanLimits& limits) {
  const Stop stop(limits.seconds, &cancelled_);
  random_ = Random(limits.seed);
  start_.assign(start.begin(), start.end());
  *sampler_ = Sampler(*space_, start_, goals_);
  edges_before_ = space_->edges();
  forget_best();
  // A new path is found sooner than the tree is checked.
  std::uint64_t left = limits.iterations;
  const bool met = connect_->run(start_, random_, stop, kInfinity, left);
  iterations_ = limits.iterations - left;
  if (met) {
    publish(connect_->path(), connect_->cost(), stop.elapsed());
  }
  Configuration orphans;
  rrt_star_->cut(added, stop, orphans);
  if (!rrt_star_->start_from(start.data())) {
    rrt_star_ = std::make_unique<RrtStar>(*space_, *sampler_, start_, kRrtStarRange);
  }
  if (met) {
    rrt_star_->adopt(*connect_);
  }
  if (std::isfinite(rrt_star_->best())) {
    publish(stop.elapsed());
  }
  join(orphans, stop);
  return search(limits, stop);
}

// Configurations of the old tree: reconnects those that are still reachable.
void Planner::join(const Configuration& orphans, const Stop& stop) {
  for (std::size_t i = 0; i < orphans.size() && !stop.now(); i += space_->size()) {
    if (rrt_star_->grow(orphans.data() + i, stop)) {
      publish(stop.elapsed());
    }
  }
}

// Until there is a path, and then until time is up.
PlanEnd Planner::search(const PlanLimits& limits, const Stop& stop) {
  if (!std::isfinite(rrt_star_->best()) && iterations_ < limits.iterations) {
    std::uint64_t left = limits.iterations - iterations_;
    const bool met = connect_->run(start_, random_, stop, kInfinity, left);
    iterations_ = limits.iterations - left;
    if (met) {
      rrt_star_->adopt(*connect_);
      publish(stop.elapsed());
    }
  }
  const bool found = std::isfinite(best_.cost);
  if (std::isfinite(rrt_star_->best())) {
    improve(limits, stop);
  }
  const bool cancelled = cancelled_.exchange(false);
  return found                                 ? PlanEnd::improved
         : cancelled                           ? PlanEnd::cancelled
         : iterations_ >= limits.iterations    ? PlanEnd::exhausted
                                               : PlanEnd::timed_out;
}

void Planner::shorten(const Configuration& path, int attempts, const Stop& stop) {
  if (path.size() < 3 * space_->size()) {
    return;  // a straight line
  }
  Shortcut shortcut(*space_, path);
  shortcut.leave_out();
  int vain = 0;
  for (int i = 0; i < attempts && vain < kIdle && !stop.now(); ++i) {
    vain = shortcut.improve(random_) ? 0 : vain + 1;
  }
  if (rrt_star_->insert(shortcut.waypoints())) {
    publish(stop.elapsed());
  }
}

void Planner::improve(const PlanLimits& limits, const Stop& stop) {
  const double straight = sampler_->to_goal(start_.data()) * (1.0 + 1e-9);  // nothing is shorter
  const double enough = std::max(limits.good_enough, straight);
  Configuration q(space_->size());
  shorten(rrt_star_->path(), kFirstAttempts, stop);
  std::size_t settled = kFewNodes;
  for (int round = 1; iterations_ < limits.iterations && rrt_star_->best() > enough && !stop.now(); ++round, ++iterations_) {
    if (round % kRound == 0) {
      std::uint64_t left = kRestartSamples;
      if (connect_->run(start_, random_, stop, rrt_star_->best() * kRestartBound, left)) {
        shorten(connect_->path(), kAttempts, stop);
      }
      continue;
    }
    if (round % kRound == kRound / 2) {
      shorten(rrt_star_->path(), kAttempts, stop);
      continue;
    }
    const bool sampled = random_.uniform() < kLocalShare ? near_best(q.data())
                                                         : sampler_->informed(random_, rrt_star_->best(), q.data());
    if (sampled && rrt_star_->grow(q.data(), stop)) {
      publish(stop.elapsed());
    }
    if (rrt_star_->tree().size() > 2 * settled) {
      rrt_star_->prune();
      settled = std::max(kFewNodes, rrt_star_->tree().size());
    }
  }
}

// A sample near the best path. False: it is out of the limits.
bool Planner::near_best(double* q) {
  const Configuration& path = best_.waypoints;  // which this thread alone changes
  const std::size_t dims = space_->size(), edge = random_.below(path.size() / dims - 1);
  const double t = random_.uniform(), spread = 0.3 * std::exp(-3.0 * random_.uniform());
  for (std::size_t d = 0; d < dims; ++d) {
    const double a = path[edge * dims + d], b = path[(edge + 1) * dims + d];
    q[d] = a + t * (b - a) + spread * random_.normal();
  }
  space_->settle(q);
  return space_->contains(q);
}

}  // namespace splatbot::planning
