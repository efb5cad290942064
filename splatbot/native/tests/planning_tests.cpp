// SPDX-License-Identifier: Apache-2.0
// The planner among shapes of exact geometry, while another thread looks on and calls it off.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "promises.hpp"
#include "splatbot/planning/planner.hpp"
#include "splatbot/planning/shortcut.hpp"

namespace {

using namespace splatbot::planning;

// Configurations outside of balls around points of the first two dimensions.
class Balls final : public Space {
 public:
  struct Ball {
    double x, y, radius;
  };

  Balls(std::size_t dims, std::vector<Ball> balls)
      : Space(Configuration(dims, -1.0), Configuration(dims, 1.0)), balls_(std::move(balls)) {}

  void add(const Ball& ball) { balls_.push_back(ball); }

 protected:
  bool check(const double* a, const double* b) override {
    const double dx = b[0] - a[0], dy = b[1] - a[1], squared = dx * dx + dy * dy;
    return std::none_of(balls_.begin(), balls_.end(), [&](const Ball& ball) {
      const double along = squared > 0.0 ? ((ball.x - a[0]) * dx + (ball.y - a[1]) * dy) / squared : 0.0;
      const double t = std::clamp(along, 0.0, 1.0);
      return std::hypot(a[0] + t * dx - ball.x, a[1] + t * dy - ball.y) <= ball.radius;
    });
  }

 private:
  std::vector<Ball> balls_;
};

void check_tree(Space& space, const Tree& tree, const std::string& what) {
  int roots = 0;
  for (std::int32_t i = 0; i < static_cast<std::int32_t>(tree.size()); ++i) {
    const std::int32_t up = tree.parent(i);
    if (up < 0) {
      ++roots;
      promise(tree.cost(i) == 0.0, what + ": a root costs nothing");
      continue;
    }
    const double cost = tree.cost(up) + space.distance(tree.at(up), tree.at(i));
    promise(std::abs(tree.cost(i) - cost) <= 1e-12 * cost, what + ": a node costs what its parent does and the edge");
    promise(space.free(tree.at(up), tree.at(i)), what + ": every edge is free");
    promise(tree.branch(i).size() <= tree.size(), what + ": no way runs in a circle");
  }
  promise(roots == 1, what + ": there is one root");
}

double shortest(double far, double radius) {
  return 2.0 * std::sqrt(far * far - radius * radius) + radius * (3.14159265358979 - 2.0 * std::acos(radius / far));
}

void check_neighbours() {
  Random random(1);
  Neighbours index(5);
  std::vector<double> points;
  for (int i = 0; i < 3000; ++i) {
    double q[5];
    for (double& x : q) {
      x = random.uniform();
    }
    index.add(q);
    points.insert(points.end(), q, q + 5);
    if (i % 97 != 0) {
      continue;
    }
    std::vector<std::pair<float, std::int32_t>> all;
    for (int k = 0; k <= i; ++k) {
      float sum = 0.0F;
      for (int d = 0; d < 5; ++d) {
        const float apart = static_cast<float>(points[static_cast<std::size_t>(5 * k + d)]) - 0.5F;
        sum += apart * apart;
      }
      all.emplace_back(sum, k);
    }
    std::sort(all.begin(), all.end());
    const double middle[5] = {0.5, 0.5, 0.5, 0.5, 0.5};
    const std::int32_t near = index.nearest(middle);
    const auto place = std::find_if(all.begin(), all.end(), [&](const auto& one) { return one.second == near; });
    promise(place != all.end() && place->first - all[0].first < 1e-6F, "the nearest is the nearest");
    const std::size_t k = std::min<std::size_t>(17, all.size());
    float farthest = 0.0F;
    const auto found = index.nearest(middle, 17);
    for (const Neighbour& one : found) {
      farthest = std::max(farthest, one.squared);
    }
    promise(found.size() == k && std::abs(farthest - all[k - 1].first) < 1e-6F, "the k nearest are the k nearest");
  }
}

void check_optimum(std::size_t dims) {
  const auto space = std::make_shared<Balls>(dims, std::vector<Balls::Ball>{{0.0, 0.0, 0.25}});
  Planner planner(space);
  Configuration start(dims, -0.2), goal(dims, 0.2);
  start[0] = -0.8;
  goal[0] = 0.8;
  start[1] = goal[1] = 0.0;
  const double known = std::hypot(shortest(0.8, 0.25), 0.4 * std::sqrt(static_cast<double>(dims - 2)));
  const PlanEnd end = planner.run(start, goal, {.seconds = 60.0, .iterations = 3000, .seed = 7});
  const BestPath best = planner.best();
  promise(end == PlanEnd::improved && best.cost >= known * (1 - 1e-9) && best.cost < 1.02 * known,
          "a path is within 2 % of the shortest");
  check_tree(*space, *planner.tree(), "the tree");
  for (std::size_t i = 1; i < best.history.size(); ++i) {
    promise(best.history[i].cost < best.history[i - 1].cost, "costs fall");
  }
  Planner again(space);
  again.run(start, goal, {.seconds = 60.0, .iterations = 3000, .seed = 7});
  promise(again.best().waypoints == best.waypoints, "a seed and a number of iterations give one path");

  // A second ball on the path: the tree is cut and joined again, from further on.
  const std::size_t middle = best.waypoints.size() / dims / 2;
  const Balls::Ball in_the_way{best.waypoints[middle * dims], best.waypoints[middle * dims + 1], 0.1};
  Balls added(dims, {in_the_way});
  space->add(in_the_way);
  Configuration here(dims);
  for (std::size_t d = 0; d < dims; ++d) {
    here[d] = 0.9 * best.waypoints[d] + 0.1 * best.waypoints[dims + d];
  }
  const PlanEnd repaired = planner.rerun(here, added, {.seconds = 60.0, .iterations = 2000, .seed = 3});
  promise(repaired == PlanEnd::improved, "a path is repaired");
  check_tree(*space, *planner.tree(), "the repaired tree");
  const Configuration path = planner.best().waypoints;
  promise(std::equal(here.begin(), here.end(), path.begin()) && std::equal(goal.begin(), goal.end(), path.end() - static_cast<std::ptrdiff_t>(dims)),
          "the repaired path leads from where the arm is to the goal");
}

void check_others() {
  const auto space = std::make_shared<Balls>(2, std::vector<Balls::Ball>{{0.0, 0.0, 0.25}});
  Planner planner(space);
  const Configuration start{-0.8, 0.0}, goals{0.8, 0.0, -0.8, 0.0, 0.7, 0.7};
  promise(planner.run(start, goals, {.seconds = 1.0}) == PlanEnd::improved && planner.best().cost == 0.0,
          "a start that is a goal costs nothing");
  std::vector<Balls::Ball> ring;
  for (int i = 0; i < 40; ++i) {
    ring.push_back({0.5 * std::cos(0.157 * i), 0.5 * std::sin(0.157 * i), 0.1});
  }
  Planner enclosed(std::make_shared<Balls>(2, ring));
  const Configuration inside{0.0, 0.0}, outside{0.9, 0.9};
  promise(enclosed.run(inside, outside, {.seconds = 60.0, .iterations = 500}) == PlanEnd::exhausted, "a wall is a wall");
  promise(enclosed.run(inside, outside, {.seconds = 0.02}) == PlanEnd::timed_out, "time is up");

  std::atomic<bool> done{false};
  PlanEnd end = PlanEnd::timed_out;
  std::thread search([&] {
    end = planner.run(start, std::span<const double>(goals).first(2), {.seconds = 60.0});
    done = true;
  });
  for (BestPath best = planner.best(); best.waypoints.empty() || best.cost == 0.0; best = planner.best()) {
    std::this_thread::yield();
  }
  while (!done) {
    planner.cancel();
    std::this_thread::yield();
  }
  search.join();
  promise(end == PlanEnd::improved, "a search that is called off keeps its path");
}

}  // namespace

void check_planning() {
  check_neighbours();
  check_optimum(2);
  check_optimum(7);
  check_others();
}
