// SPDX-License-Identifier: Apache-2.0
// A first path by RRT-Connect, shortened, then RRT* over the union of its trees until time is up.
#pragma once

#include <atomic>
#include <cstdint>
#include <memory>
#include <mutex>
#include <span>
#include <vector>

#include "splatbot/planning/rrt_star.hpp"

namespace splatbot::planning {

struct PlanLimits {
  double seconds = 0.028;
  std::uint64_t iterations = ~std::uint64_t{0};  // of the trees' growth; makes the answer depend on the seed alone
  std::uint64_t seed = 0;
  double good_enough = 0.0;  // a cost at which to stop
};

enum class PlanEnd { improved, exhausted, timed_out, cancelled };  // improved: there is a path

struct Improvement {
  double seconds, cost;
};

struct BestPath {
  Configuration waypoints;  // (N, dims); empty: none yet
  double cost;
  std::vector<Improvement> history;
};

class Planner {
 public:
  explicit Planner(std::shared_ptr<Space> space);

  // From the start to one of the goals (K, dims), all free. The tree is kept until the next call.
  PlanEnd run(std::span<const double> start, std::span<const double> goals, const PlanLimits& limits);

  // Replans after the space has changed. The part of the last tree that collides with `added` is cut off, the rest is
  // kept. Planning goes on from `start`, on the last best path or elsewhere. Edges of the tree are checked against
  // `added` alone.
  PlanEnd rerun(std::span<const double> start, Space& added, const PlanLimits& limits);

  // The following may be called while run() is busy in another thread.
  BestPath best() const;
  void cancel() noexcept { cancelled_.store(true, std::memory_order_relaxed); }

  // Statistics of the last run.
  const Tree* tree() const noexcept { return rrt_star_ ? &rrt_star_->tree() : nullptr; }
  std::uint64_t iterations() const noexcept { return iterations_; }
  std::uint64_t edges() const noexcept { return space_->edges() - edges_before_; }

 private:
  PlanEnd search(const PlanLimits& limits, const Stop& stop);
  void improve(const PlanLimits& limits, const Stop& stop);
  void shorten(const Configuration& path, int attempts, const Stop& stop);
  bool near_best(double* q);
  void publish(double seconds);
  void publish(Configuration waypoints, double cost, double seconds);
  void forget_best();
  void begin(std::span<const double> start);
  void join(const Configuration& orphans, const Stop& stop);

  std::shared_ptr<Space> space_;
  Configuration start_, goals_;
  std::unique_ptr<Sampler> sampler_;
  std::unique_ptr<RrtStar> rrt_star_;
  std::unique_ptr<Connect> connect_;
  Random random_{0};
  std::atomic<bool> cancelled_{false};
  std::uint64_t iterations_ = 0, edges_before_ = 0;
  mutable std::mutex mutex_;
  BestPath best_;
};

}  // namespace splatbot::planning
