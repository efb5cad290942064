// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/tree.hpp"

#include <algorithm>

namespace splatbot::planning {

namespace {
std::size_t of(std::int32_t node) { return static_cast<std::size_t>(node); }
}  // namespace

std::size_t Tree::bytes() const noexcept {
  return (q_.capacity() + cost_.capacity()) * sizeof(double) +
         (parent_.capacity() + child_.capacity() + next_.capacity() + previous_.capacity()) * sizeof(std::int32_t) +
         index_.bytes();
}

std::int32_t Tree::add(const double* q, std::int32_t parent) {
  const auto node = static_cast<std::int32_t>(size());
  q_.insert(q_.end(), q, q + dims_);
  index_.add(q);
  parent_.push_back(-1);
  child_.push_back(-1);
  next_.push_back(-1);
  previous_.push_back(-1);
  cost_.push_back(0.0);
  if (parent >= 0) {
    attach(node, parent);
    cost_[of(node)] = cost(parent) + space_->distance(at(parent), at(node));
  }
  return node;
}

void Tree::hang(std::int32_t node, std::int32_t parent) {
  detach(node);
  attach(node, parent);
  renew_costs(node);
}

void Tree::root(std::int32_t node) {
  const std::vector<std::int32_t> nodes = branch(node);
  for (std::size_t i = nodes.size(); i-- > 1;) {
    detach(nodes[i]);
  }
  for (std::size_t i = nodes.size(); i-- > 1;) {
    attach(nodes[i - 1], nodes[i]);
  }
  renew_costs(node);
}

// Subtracts the saving from a node and all nodes below it.
void Tree::renew_costs(std::int32_t node) {
  stack_.assign(1, node);
  while (!stack_.empty()) {
    const std::int32_t n = stack_.back();
    stack_.pop_back();
    const std::int32_t above = parent_[of(n)];
    cost_[of(n)] = above < 0 ? 0.0 : cost(above) + space_->distance(at(above), at(n));
    for (std::int32_t c = child_[of(n)]; c >= 0; c = next_[of(c)]) {
      stack_.push_back(c);
    }
  }
}

std::vector<std::int32_t> Tree::branch(std::int32_t node) const {
  std::vector<std::int32_t> nodes;
  for (; node >= 0; node = parent(node)) {
    nodes.push_back(node);
  }
  std::reverse(nodes.begin(), nodes.end());
  return nodes;
}

std::vector<std::int32_t> Tree::keep(const std::vector<std::uint8_t>& kept) {
  std::vector<std::int32_t> renamed(size(), -1);
  std::int32_t count = 0;
  for (std::size_t i = 0; i < size(); ++i) {
    if (kept[i] != 0) {
      renamed[i] = count++;
    }
  }
  const std::vector<double> q = std::move(q_), cost = std::move(cost_);
  const std::vector<std::int32_t> parent = std::move(parent_);
  clear();
  for (std::size_t i = 0; i < kept.size(); ++i) {
    if (kept[i] != 0) {
      add(q.data() + i * dims_, -1);
      cost_.back() = cost[i];
    }
  }
  for (std::size_t i = 0; i < kept.size(); ++i) {
    if (kept[i] != 0 && parent[i] >= 0) {
      attach(renamed[i], renamed[of(parent[i])]);
    }
  }
  return renamed;
}

void Tree::clear() noexcept {
  q_.clear();
  cost_.clear();
  parent_.clear();
  child_.clear();
  next_.clear();
  previous_.clear();
  index_.clear();
}

void Tree::attach(std::int32_t node, std::int32_t parent) {
  parent_[of(node)] = parent;
  const std::int32_t first = child_[of(parent)];
  next_[of(node)] = first;
  previous_[of(node)] = -1;
  if (first >= 0) {
    previous_[of(first)] = node;
  }
  child_[of(parent)] = node;
}

void Tree::detach(std::int32_t node) {
  const std::int32_t parent = parent_[of(node)], next = next_[of(node)], previous = previous_[of(node)];
  if (parent < 0) {
    return;
  }
  if (previous >= 0) {
    next_[of(previous)] = next;
  } else {
    child_[of(parent)] = next;
  }
  if (next >= 0) {
    previous_[of(next)] = previous;
  }
  parent_[of(node)] = -1;
}

}  // namespace splatbot::planning
