// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/sampler.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace splatbot::planning {

Space::Space(std::span<const double> lower, std::span<const double> upper)
    : lower_(lower.begin(), lower.end()), upper_(upper.begin(), upper.end()) {
  if (lower.empty() || lower.size() != upper.size()) {
    throw std::invalid_argument("the limits differ in number, or there are none");
  }
  for (std::size_t d = 0; d < lower.size(); ++d) {
    if (!(lower[d] <= upper[d]) || !std::isfinite(lower[d]) || !std::isfinite(upper[d])) {
      throw std::invalid_argument("a lower limit is above its upper one, or not finite");
    }
  }
}

bool Space::contains(const double* q) const {
  for (std::size_t d = 0; d < size(); ++d) {
    if (!(q[d] >= lower_[d] && q[d] <= upper_[d])) {
      return false;
    }
  }
  return true;
}

Sampler::Sampler(const Space& space, std::span<const double> start, std::span<const double> goals)
    : space_(&space), start_(start.begin(), start.end()), goals_(goals.begin(), goals.end()) {
  for (std::size_t g = 0; g < goals.size() / start.size(); ++g) {
    distance_.push_back(space.distance(start_.data(), goal(g)));
  }
}

double Sampler::to_goal(const double* q) const {
  double least = std::numeric_limits<double>::infinity();
  for (std::size_t g = 0; g < goals(); ++g) {
    least = std::min(least, space_->distance(q, goal(g)));
  }
  return least;
}

void Sampler::uniform(Random& random, double* q) const {
  for (std::size_t d = 0; d < start_.size(); ++d) {
    q[d] = space_->lower()[d] + random.uniform() * (space_->upper()[d] - space_->lower()[d]);
  }
}

bool Sampler::informed(Random& random, double bound, double* q) {
  const std::size_t dims = start_.size();
  open_.clear();
  for (std::size_t g = 0; g < goals(); ++g) {
    if (distance_[g] < bound) {
      open_.push_back(g);
    }
  }
  if (open_.empty()) {
    return false;
  }
  for (int attempt = 0; attempt < 64; ++attempt) {
    const std::size_t g = open_[random.below(open_.size())];
    const double along = 0.5 * bound, apart = distance_[g];
    const double across = 0.5 * std::sqrt(std::max(0.0, bound * bound - apart * apart));
    // A point of the unit ball, stretched; then the reflection that takes the first axis to the line between the foci.
    double norm = 0.0;
    for (std::size_t d = 0; d < dims; ++d) {
      q[d] = random.normal();
      norm += q[d] * q[d];
    }
    const double scale = std::pow(random.uniform(), 1.0 / static_cast<double>(dims)) / std::sqrt(norm);
    for (std::size_t d = 0; d < dims; ++d) {
      q[d] *= scale * (d == 0 ? along : across);
    }
    if (apart > 0.0) {
      double v2 = 0.0, dot = 0.0;
      for (std::size_t d = 0; d < dims; ++d) {  // v = e1 - a, a the unit vector between the foci
        const double v = (d == 0 ? 1.0 : 0.0) - (goal(g)[d] - start_[d]) / apart;
        v2 += v * v;
        dot += v * q[d];
      }
      if (v2 > 1e-20) {
        for (std::size_t d = 0; d < dims; ++d) {
          q[d] -= 2.0 * dot / v2 * ((d == 0 ? 1.0 : 0.0) - (goal(g)[d] - start_[d]) / apart);
        }
      }
    }
    for (std::size_t d = 0; d < dims; ++d) {
      q[d] += 0.5 * (start_[d] + goal(g)[d]);
    }
    space_->settle(q);
    if (space_->contains(q)) {
      return true;
    }
  }
  return false;
}

}  // namespace splatbot::planning
