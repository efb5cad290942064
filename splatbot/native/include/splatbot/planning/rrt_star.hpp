// SPDX-License-Identifier: Apache-2.0
// RRT* (Karaman and Frazzoli, IJRR 2011): a tree from the start that is rewired as it grows. Each new node considers its
// k = e (1 + 1/d) ln n nearest neighbours, with n nodes in d dimensions. Costs propagate to all descendants. Edges are
// checked lazily, in the order of the path cost over them.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "splatbot/planning/connect.hpp"
#include "splatbot/planning/sampler.hpp"
#include "splatbot/planning/tree.hpp"

namespace splatbot::planning {

class RrtStar {
 public:
  RrtStar(Space& space, Sampler& sampler, std::span<const double> start, double range);

  const Tree& tree() const noexcept { return tree_; }
  double best() const noexcept { return best_; }  // infinity while no goal is in the tree
  Configuration path() const;                     // to the best goal (N, dims)

  // Joins both trees of RRT-Connect to one. The edges of the goals' tree are reversed.
  void adopt(const Connect& connect);

  // Extends the tree by one step towards q. Returns true if the best path became shorter.
  bool grow(const double* q, const Stop& stop);

  // Adds a path (N, dims) of free edges from the start. Returns true if the best path became shorter.
  bool insert(const Configuration& path);

  // Removes the subtrees below edges that collide in `added`, and returns their configurations in `orphans` (N, dims),
  // those nearest to the root first. The edges of the best path are checked first. Returns false on a timeout; then only
  // the root remains.
  bool cut(Space& added, const Stop& stop, Configuration& orphans);

  // Moves the root of the tree to q, which lies on the best path or next to the root. Returns false if q cannot be joined.
  bool start_from(const double* q);

  // Removes nodes that no path shorter than the best can pass through (informed pruning).
  void prune();

 private:
  struct Candidate {
    double total, length;  // cost of the path over this neighbour, and of the edge alone
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
  std::vector<std::int32_t> goal_nodes_;  // node of each goal, -1 if it is not in the tree
  double best_;
  std::int32_t best_node_ = -1;
  Configuration step_;
  std::vector<Candidate> candidates_;
};

}  // namespace splatbot::planning
