// SPDX-License-Identifier: Apache-2.0
// RRT* (Karaman and Frazzoli, IJRR 2011): a tree from the start that is rewired as it grows, k nearest neighbours with
// k = e (1 + 1/d) ln n, costs propagated to everything below, edges checked lazily in the order of what they promise.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "splatbot/planning/connect.hpp"
#include "splatbot/planning/sampler.hpp"
#include "splatbot/planning/tree.hpp"

namespace splatbot::planning {

class Star {
 public:
  Star(Space& space, Sampler& sampler, std::span<const double> start, double range);

  const Tree& tree() const noexcept { return tree_; }
  double best() const noexcept { return best_; }  // infinity: no goal is in the tree
  Configuration path() const;                     // to the best goal (N, dims)

  // Takes over both trees of a meeting as one, the goals' turned around.
  void adopt(const Connect& connect);

  // One step towards q. True: the best path is shorter.
  bool grow(const double* q, const Stop& stop);

  // Enters a path (N, dims) of free edges from the start. True: the best path is shorter.
  bool insert(const Configuration& path);

  // Cuts off what hangs on edges that `added` does not leave free; they are given as configurations (N, dims), those
  // nearest to the root first. The best path's edges are asked first. False: time was up, and all but the root is cut off.
  bool cut(Space& added, const Stop& stop, Configuration& orphans);

  // The tree's root becomes q, on the best path or next to the root. False: q cannot be joined to the tree.
  bool start_from(const double* q);

  // Leaves out what no path better than the best can pass through.
  void prune();

 private:
  struct Candidate {
    double total, length;  // cost from the start over this neighbour, and of the edge
    std::int32_t node;
    bool blocked;
  };

  std::int32_t enter(const double* q, std::int32_t parent);
  std::int32_t find(const double* q);
  void gather(const double* q);
  bool update();
  void drop(const std::vector<std::uint8_t>& kept);

  Space* space_;
  Sampler* sampler_;
  double range_;
  Tree tree_;
  std::int32_t root_ = -1;
  std::vector<std::int32_t> goal_nodes_;  // of each goal, -1: not in the tree
  double best_;
  std::int32_t best_node_ = -1;
  Configuration step_;
  std::vector<Candidate> candidates_;
};

}  // namespace splatbot::planning
