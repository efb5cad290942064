// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/connect.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace splatbot::planning {

namespace {
// Until a path is known, samples come from an ellipsoid around the straight line that widens by this with each sample.
constexpr double kFirstWidth = 1.2, kWidening = 1.03, kAnywhere = 4.0;
}  // namespace

Connect::Connect(Space& space, Sampler& sampler, double range)
    : space_(&space), sampler_(&sampler), range_(range), trees_{Tree(space), Tree(space)}, sample_(space.size()), step_(space.size()) {}

void Connect::begin(std::span<const double> start) {
  start_.assign(start.begin(), start.end());
  meeting_[0] = meeting_[1] = -1;
  trees_[0].clear();
  trees_[1].clear();
  trees_[0].add(start_.data(), -1);
  for (std::size_t g = 0; g < sampler_->goals(); ++g) {
    trees_[1].add(sampler_->goal(g), -1);
  }
  widest_ = kFirstWidth;
}

bool Connect::run(std::span<const double> start, Random& random, const Stop& stop, double bound,
                  std::uint64_t& iterations) {
  begin(start);
  if (!std::isfinite(bound) && connect_directly(start, stop, bound)) {
    return true;
  }
  int grows = 0;
  while (iterations > 0 && !stop.now()) {
    --iterations;
    if (!sample(random, bound, sample_.data())) {
      continue;
    }
    if (extend(grows, sample_.data(), bound) == Step::blocked) {
      if (trees_[grows].size() > trees_[1 - grows].size()) {
        grows = 1 - grows;
      }
      continue;
    }
    const std::int32_t reached = added_;
    std::copy_n(trees_[grows].at(reached), sample_.size(), sample_.data());
    Step step = Step::advanced;
    while (step == Step::advanced && !stop.now()) {
      step = extend(1 - grows, sample_.data(), bound);
    }
    if (step == Step::reached) {
      meeting_[grows] = reached;
      meeting_[1 - grows] = added_;
      if (cost() < bound) {
        return true;
      }
    }
    if (trees_[grows].size() > trees_[1 - grows].size()) {
      grows = 1 - grows;
    }
  }
  return false;
}

bool Connect::connect_directly(std::span<const double> start, const Stop& stop, double bound) {
  std::vector<std::size_t> order(sampler_->goals());
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) {
    return space_->distance(start.data(), sampler_->goal(a)) < space_->distance(start.data(), sampler_->goal(b));
  });
  for (const std::size_t g : order) {
    if (stop.now()) {
      return false;
    }
    if (space_->distance(start.data(), sampler_->goal(g)) < bound && space_->free(start.data(), sampler_->goal(g))) {
      meeting_[0] = trees_[0].add(sampler_->goal(g), 0);
      meeting_[1] = static_cast<std::int32_t>(g);
      return true;
    }
  }
  return false;
}

bool Connect::sample(Random& random, double bound, double* q) {
  if (std::isfinite(bound)) {
    return sampler_->informed(random, bound, q);
  }
  if (widest_ > kAnywhere || random.uniform() < 0.2) {
    sampler_->uniform(random, q);
    return true;
  }
  widest_ *= kWidening;
  return sampler_->informed(random, widest_ * std::max(0.5, sampler_->to_goal(start_.data())), q);
}

double Connect::to_end(int tree, const double* q) const {
  return tree == 0 ? sampler_->to_goal(q) : space_->distance(start_.data(), q);
}

Connect::Step Connect::extend(int tree, const double* toward, double bound) {
  Tree& t = trees_[tree];
  const std::int32_t near = t.index().nearest(toward);
  const double apart = space_->distance(t.at(near), toward);
  if (apart == 0.0) {
    added_ = near;
    return Step::reached;
  }
  const double share = std::min(1.0, range_ / apart);
  for (std::size_t d = 0; d < step_.size(); ++d) {
    step_[d] = share < 1.0 ? t.at(near)[d] + share * (toward[d] - t.at(near)[d]) : toward[d];
  }
  if (t.cost(near) + share * apart + to_end(tree, step_.data()) >= bound || !space_->free(t.at(near), step_.data())) {
    return Step::blocked;
  }
  added_ = t.add(step_.data(), near);
  return share < 1.0 ? Step::advanced : Step::reached;
}

Configuration Connect::path() const {
  Configuration q;
  const std::size_t dims = start_.size();
  for (const std::int32_t node : trees_[0].branch(meeting_[0])) {
    q.insert(q.end(), trees_[0].at(node), trees_[0].at(node) + dims);
  }
  for (std::int32_t node = trees_[1].parent(meeting_[1]); node >= 0; node = trees_[1].parent(node)) {
    q.insert(q.end(), trees_[1].at(node), trees_[1].at(node) + dims);
  }
  return q;
}

}  // namespace splatbot::planning
