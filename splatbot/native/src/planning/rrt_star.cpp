// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/rrt_star.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace splatbot::planning {

namespace {
constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kMinSaving = 1e-9;  // relative saving of a cheaper path
}  // namespace

RrtStar::RrtStar(Space& space, Sampler& sampler, std::span<const double> start, double range)
    : space_(&space), sampler_(&sampler), range_(range), tree_(space), goal_nodes_(sampler.goals(), -1), best_(kInfinity), step_(space.size()) {
  root_ = enter(start.data(), -1);
}

std::int32_t RrtStar::enter(const double* q, std::int32_t parent) {
  const std::int32_t node = tree_.add(q, parent);
  for (std::size_t g = 0; g < goal_nodes_.size(); ++g) {
    if (goal_nodes_[g] < 0 && std::equal(q, q + space_->size(), sampler_->goal(g))) {
      goal_nodes_[g] = node;
    }
  }
  return node;
}

// Returns the node at exactly q, or -1.
std::int32_t RrtStar::find(const double* q) {
  for (std::size_t g = 0; g < goal_nodes_.size(); ++g) {
    if (goal_nodes_[g] >= 0 && std::equal(q, q + space_->size(), sampler_->goal(g))) {
      return goal_nodes_[g];
    }
  }
  const std::int32_t near = tree_.index().nearest(q);
  return near >= 0 && std::equal(q, q + space_->size(), tree_.at(near)) ? near : -1;
}

bool RrtStar::update() {
  double least = kInfinity;
  for (const std::int32_t node : goal_nodes_) {
    if (node >= 0 && tree_.cost(node) < least) {
      least = tree_.cost(node);
      best_node_ = node;
    }
  }
  const bool better = least < best_;
  best_ = least;
  return better;
}

Configuration RrtStar::path() const {
  Configuration q;
  for (const std::int32_t node : tree_.branch(best_node_)) {
    q.insert(q.end(), tree_.at(node), tree_.at(node) + space_->size());
  }
  return q;
}

void RrtStar::adopt(const Connect& connect) {
  const Tree& a = connect.from_start();
  const Tree& b = connect.from_goals();
  std::vector<std::int32_t> renamed(a.size(), root_);  // the root is already there
  for (std::int32_t i = 1; i < static_cast<std::int32_t>(a.size()); ++i) {
    renamed[static_cast<std::size_t>(i)] = enter(a.at(i), renamed[static_cast<std::size_t>(a.parent(i))]);
  }
  // A node of the goals' tree in a depth-first traversal from the meeting node.
  struct Visit {
    std::int32_t node, from, parent;  // in b; the predecessor in b; the parent in this tree
  };
  std::vector<Visit> waiting{{connect.meeting(1), -1, renamed[static_cast<std::size_t>(connect.meeting(0))]}};
  while (!waiting.empty()) {
    const Visit v = waiting.back();
    waiting.pop_back();
    const std::int32_t here = v.from < 0 ? v.parent : enter(b.at(v.node), v.parent);
    const std::int32_t up = b.parent(v.node);
    if (up >= 0 && up != v.from) {
      waiting.push_back({up, v.node, here});
    }
    for (std::int32_t c = b.first_child(v.node); c >= 0; c = b.next_sibling(c)) {
      if (c != v.from) {
        waiting.push_back({c, v.node, here});
      }
    }
  }
  update();
}

// Collects the neighbours of q, sorted by the cost of the path over them.
void RrtStar::gather(const double* q) {
  const double dims = static_cast<double>(space_->size());
  const double n = static_cast<double>(tree_.size() + 1);
  const auto k = static_cast<std::size_t>(std::ceil(2.718281828459045 * (1.0 + 1.0 / dims) * std::log(n)));
  candidates_.clear();
  for (const Neighbour& one : tree_.index().nearest(q, std::max<std::size_t>(1, k))) {
    const double length = space_->distance(tree_.at(one.id), q);
    candidates_.push_back({tree_.cost(one.id) + length, length, one.id, false});
  }
  std::sort(candidates_.begin(), candidates_.end(), [](const Candidate& a, const Candidate& b) {
    return a.total < b.total || (a.total == b.total && a.node < b.node);
  });
}

bool RrtStar::grow(const double* q, const Stop& stop) {
  const std::size_t dims = space_->size();
  const std::int32_t near = tree_.index().nearest(q);
  const double apart = space_->distance(tree_.at(near), q);
  if (apart < 1e-9) {
    return false;
  }
  const double share = std::min(1.0, range_ / apart);
  for (std::size_t d = 0; d < dims; ++d) {
    step_[d] = share < 1.0 ? tree_.at(near)[d] + share * (q[d] - tree_.at(near)[d]) : q[d];
  }
  gather(step_.data());
  const double rest = sampler_->to_goal(step_.data());
  std::int32_t parent = -1;
  for (Candidate& c : candidates_) {
    if (c.total + rest >= best_ || stop.now()) {
      return false;
    }
    if (space_->free(tree_.at(c.node), step_.data())) {
      parent = c.node;
      break;
    }
    c.blocked = true;
  }
  if (parent < 0) {
    return false;
  }
  const std::int32_t node = enter(step_.data(), parent);
  for (const Candidate& c : candidates_) {
    const double total = tree_.cost(node) + c.length;
    if (c.blocked || c.node == parent || !(total < tree_.cost(c.node) * (1.0 - kMinSaving)) ||
        total + sampler_->to_goal(tree_.at(c.node)) >= best_) {
      continue;
    }
    if (stop.now()) {
      break;
    }
    if (space_->free(tree_.at(node), tree_.at(c.node))) {
      tree_.hang(c.node, node);
    }
  }
  return update();
}

bool RrtStar::insert(const Configuration& path) {
  const std::size_t dims = space_->size();
  std::int32_t above = root_;
  for (std::size_t i = dims; i < path.size(); i += dims) {
    const double* q = path.data() + i;
    std::int32_t node = find(q);
    if (node < 0) {
      node = enter(q, above);
    } else if (tree_.cost(above) + space_->distance(tree_.at(above), q) < tree_.cost(node) * (1.0 - kMinSaving)) {
      tree_.hang(node, above);
    }
    above = node;
  }
  return update();
}

void RrtStar::prune() {
  if (!std::isfinite(best_)) {
    return;
  }
  const std::size_t n = tree_.size();
  std::vector<std::uint8_t> kept(n, 0);
  for (std::size_t i = 0; i < n; ++i) {
    const auto node = static_cast<std::int32_t>(i);
    if (kept[i] != 0 || sampler_->through(tree_.at(node)) > best_ * (1.0 + kMinSaving)) {
      continue;
    }
    for (std::int32_t up = node; up >= 0 && kept[static_cast<std::size_t>(up)] == 0; up = tree_.parent(up)) {
      kept[static_cast<std::size_t>(up)] = 1;
    }
  }
  kept[static_cast<std::size_t>(root_)] = 1;
  drop(kept);
}

void RrtStar::drop(const std::vector<std::uint8_t>& kept) {
  const std::vector<std::int32_t> renamed = tree_.keep(kept);
  root_ = renamed[static_cast<std::size_t>(root_)];
  for (std::int32_t& node : goal_nodes_) {
    node = node >= 0 ? renamed[static_cast<std::size_t>(node)] : -1;
  }
  update();
}

bool RrtStar::cut(Space& added, const Stop& stop, Configuration& orphans) {
  const std::size_t n = tree_.size();
  orphans.clear();
  std::vector<std::uint8_t> free(n, 0), kept(n, 0);
  if (std::isfinite(best_)) {
    for (const std::int32_t node : tree_.branch(best_node_)) {
      const std::int32_t up = tree_.parent(node);
      free[static_cast<std::size_t>(node)] = up < 0 || added.free(tree_.at(up), tree_.at(node)) ? 1 : 2;
    }
  }
  std::vector<std::int32_t> order{root_};
  kept[static_cast<std::size_t>(root_)] = 1;
  bool in_time = true;
  for (std::size_t i = 0; i < order.size(); ++i) {  // parents before children
    const std::int32_t up = order[i];
    for (std::int32_t c = tree_.first_child(up); c >= 0; c = tree_.next_sibling(c)) {
      const auto child = static_cast<std::size_t>(c);
      if (kept[static_cast<std::size_t>(up)] != 0 && in_time) {
        in_time = !stop.now();
        kept[child] = free[child] == 1 || (free[child] == 0 && added.free(tree_.at(up), tree_.at(c))) ? 1 : 0;
      }
      if (kept[child] == 0) {
        orphans.insert(orphans.end(), tree_.at(c), tree_.at(c) + space_->size());
      }
      order.push_back(c);
    }
  }
  if (!in_time) {
    std::fill(kept.begin(), kept.end(), 0);
    kept[static_cast<std::size_t>(root_)] = 1;
  }
  drop(kept);
  return in_time;
}

bool RrtStar::start_from(const double* q) {
  std::int32_t node = find(q);
  if (node == root_) {
    return true;
  }
  if (node < 0) {
    // Between which two of the best path's waypoints? Else next to the root.
    std::int32_t above = root_, below = -1;
    if (std::isfinite(best_)) {
      const std::vector<std::int32_t> way = tree_.branch(best_node_);
      for (std::size_t i = 0; i + 1 < way.size(); ++i) {
        const double* a = tree_.at(way[i]);
        const double* b = tree_.at(way[i + 1]);
        if (space_->distance(a, q) + space_->distance(q, b) < space_->distance(a, b) + 1e-6) {
          above = way[i];
          below = way[i + 1];
          break;
        }
      }
    }
    if (!space_->free(tree_.at(above), q) || (below >= 0 && !space_->free(q, tree_.at(below)))) {
      return false;
    }
    node = enter(q, above);
    if (below >= 0) {
      tree_.hang(below, node);
    }
  }
  tree_.root(node);
  root_ = node;
  update();
  return true;
}

}  // namespace splatbot::planning
