// SPDX-License-Identifier: Apache-2.0
// Trees of configurations in flat arrays, each with the cost from its root.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "splatbot/planning/neighbours.hpp"
#include "splatbot/planning/space.hpp"

namespace splatbot::planning {

class Tree {
 public:
  explicit Tree(const Space& space) : space_(&space), dims_(space.size()), index_(space.size()) {}

  std::size_t size() const noexcept { return parent_.size(); }
  std::size_t bytes() const noexcept;
  const double* at(std::int32_t node) const { return q_.data() + static_cast<std::size_t>(node) * dims_; }
  std::int32_t parent(std::int32_t node) const { return parent_[static_cast<std::size_t>(node)]; }
  std::int32_t first_child(std::int32_t node) const { return child_[static_cast<std::size_t>(node)]; }
  std::int32_t next_sibling(std::int32_t node) const { return next_[static_cast<std::size_t>(node)]; }
  double cost(std::int32_t node) const { return cost_[static_cast<std::size_t>(node)]; }
  Neighbours& index() noexcept { return index_; }

  // A parent of -1: a root. Returns the node.
  std::int32_t add(const double* q, std::int32_t parent);
  // Hangs a node below another that is not beneath it; costs change all the way down.
  void hang(std::int32_t node, std::int32_t parent);
  // Makes a node the root of its tree: the edges up to the old root are turned around.
  void root(std::int32_t node);
  // From the root to the node.
  std::vector<std::int32_t> branch(std::int32_t node) const;
  // Leaves out the nodes not kept; every kept node's parent must be kept. Returns the new number of each, -1 for none.
  std::vector<std::int32_t> keep(const std::vector<std::uint8_t>& kept);
  void clear() noexcept;

 private:
  void attach(std::int32_t node, std::int32_t parent);
  void detach(std::int32_t node);
  void renew_costs(std::int32_t node);

  const Space* space_;
  std::size_t dims_;
  std::vector<double> q_, cost_;
  std::vector<std::int32_t> parent_, child_, next_, previous_, stack_;
  Neighbours index_;
};

}  // namespace splatbot::planning
