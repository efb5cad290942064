// SPDX-License-Identifier: Apache-2.0
#include "splatbot/planning/planner.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/shared_ptr.h>

#include <algorithm>
#include <stdexcept>

#include "arrays.hpp"
#include "bindings.hpp"
#include "splatbot/planning/arm_space.hpp"
#include "splatbot/planning/clearance.hpp"
#include "splatbot/planning/ik.hpp"

using namespace nb::literals;

namespace {

using splatbot::Arm;
using splatbot::CollisionField;
using splatbot::planning::ArmSpace;
using splatbot::planning::BestPath;
using splatbot::planning::PlanEnd;
using splatbot::planning::PlanLimits;
using splatbot::planning::Planner;
using splatbot::planning::Tree;
using Numbers = Array<const double, nb::shape<-1>>;
using Target = Array<const double, nb::shape<3, 4>>;
using Targets = Array<const double, nb::shape<-1, 3, 4>>;
using Configurations = Array<const double, nb::shape<-1, -1>>;

// A planner and how many joints it plans for.
class ArmPlanner {
 public:
  ArmPlanner(const Arm& arm, std::shared_ptr<const CollisionField> field, std::span<const double> lower,
             std::span<const double> upper, float eps)
      : joints_(lower.size()),
        space_(std::make_shared<ArmSpace>(arm, std::move(field), lower, upper, eps)),
        planner_(space_),
        eps_(eps) {}

  int run(Numbers start, Configurations goals, double seconds, std::uint64_t iterations, std::uint64_t seed,
          double good_enough) {
    if (start.shape(0) != joints_ || goals.shape(1) != joints_ || goals.shape(0) == 0) {
      throw nb::value_error("the start or the goals have another number of joints, or there is no goal");
    }
    const nb::gil_scoped_release release;
    return static_cast<int>(planner_.run(span_of(start), span_of(goals), {seconds, iterations, seed, good_enough}));
  }

  // `unpaired` is the same arm without self-collision pairs: changes of the map do not affect them.
  int rerun(Numbers start, std::shared_ptr<CollisionField> field, std::shared_ptr<CollisionField> added,
            const Arm& unpaired, double seconds, std::uint64_t iterations, std::uint64_t seed) {
    if (start.shape(0) != joints_ || planner_.tree() == nullptr) {
      throw nb::value_error("the start has another number of joints, or nothing was planned before");
    }
    const nb::gil_scoped_release release;
    space_->look_at(std::move(field));
    ArmSpace delta(unpaired, std::move(added), {space_->lower(), joints_}, {space_->upper(), joints_}, eps_);
    return static_cast<int>(planner_.rerun(span_of(start), delta, {seconds, iterations, seed, 0.0}));
  }

  // Waypoints (N, J) and history (H, 2).
  nb::tuple best() const {
    BestPath best = planner_.best();
    std::vector<double> history;
    for (const auto& one : best.history) {
      history.insert(history.end(), {one.seconds, one.cost});
    }
    const std::size_t n = best.waypoints.size() / joints_, h = best.history.size();
    return nb::make_tuple(owned(std::move(best.waypoints), {n, joints_}), best.cost, owned(std::move(history), {h, 2}));
  }

  // Nodes (N, J), parents (N) and costs (N).
  nb::tuple tree() const {
    std::vector<double> q, cost;
    std::vector<std::int32_t> parent;
    if (const Tree* tree = planner_.tree()) {
      for (std::int32_t i = 0; i < static_cast<std::int32_t>(tree->size()); ++i) {
        q.insert(q.end(), tree->at(i), tree->at(i) + joints_);
        parent.push_back(tree->parent(i));
        cost.push_back(tree->cost(i));
      }
    }
    const std::size_t n = parent.size();
    return nb::make_tuple(owned(std::move(q), {n, joints_}), owned(std::move(parent), {n}), owned(std::move(cost), {n}));
  }

  void look_at(std::shared_ptr<CollisionField> field) { space_->look_at(std::move(field)); }

  Planner& planner() { return planner_; }

 private:
  std::size_t joints_;
  std::shared_ptr<ArmSpace> space_;
  Planner planner_;
  float eps_;
};

}  // namespace

void define_planning(nb::module_& m) {
  m.def(
      "inverse_kinematics",
      [](const Arm& arm, Targets targets, Target tool, Numbers lower, Numbers upper, Configurations starts, int max_iterations) {
        const auto joints = static_cast<std::size_t>(arm.joints());
        const std::size_t n = targets.shape(0);
        if (starts.shape(0) != n || starts.shape(1) != joints || lower.shape(0) != joints || upper.shape(0) != joints) {
          throw nb::value_error("targets, starts and limits do not fit");
        }
        std::vector<double> q(starts.data(), starts.data() + starts.size()), residuals(2 * n);
        {
          const nb::gil_scoped_release release;
          for (std::size_t i = 0; i < n; ++i) {
            splatbot::planning::IkGoal goal;
            std::copy_n(targets.data() + 12 * i, 12, goal.target);
            std::copy_n(tool.data(), 12, goal.tool);
            const auto residual = splatbot::planning::solve_ik(arm, goal, span_of(lower), span_of(upper), max_iterations,
                                                               std::span(q).subspan(joints * i, joints));
            residuals[2 * i] = residual.position;
            residuals[2 * i + 1] = residual.angle;
          }
        }
        return nb::make_tuple(owned(std::move(q), {n, joints}), owned(std::move(residuals), {n, 2}));
      },
      "arm"_a, "targets"_a.noconvert(), "tool"_a.noconvert(), "lower"_a.noconvert(), "upper"_a.noconvert(),
      "starts"_a.noconvert(), "max_iterations"_a, "Joint values (N, J) and their errors (N, 2) [m, rad] to the targets (N, 3, 4)");
  m.def(
      "path_clearance",
      [](const Arm& arm, const CollisionField& field, Configurations path, double cut, int rounds,
         double seconds) {
        if (path.shape(1) != static_cast<std::size_t>(arm.joints()) || path.shape(0) < 2) {
          throw nb::value_error("the path has another number of joints, or is no path");
        }
        const nb::gil_scoped_release release;
        return splatbot::planning::path_clearance(arm, field, span_of(path), cut, rounds, seconds);
      },
      "arm"_a, "field"_a, "path"_a.noconvert(), "cut"_a, "rounds"_a, "seconds"_a,
      "A lower bound [m] of the room along a path (N, J), made better while there is time");
  nb::class_<ArmPlanner>(m, "ArmPlanner", "RRT* for an arm in a field; one run at a time")
      .def(
          "__init__",
          [](ArmPlanner* self, const Arm& arm, std::shared_ptr<CollisionField> field, Numbers lower, Numbers upper,
             float eps) { new (self) ArmPlanner(arm, std::move(field), span_of(lower), span_of(upper), eps); },
          "arm"_a, "field"_a.none(), "lower"_a.noconvert(), "upper"_a.noconvert(), "eps"_a, nb::keep_alive<1, 2>())
      .def("run", &ArmPlanner::run, "start"_a.noconvert(), "goals"_a.noconvert(), "seconds"_a, "iterations"_a, "seed"_a,
           "good_enough"_a, "How it ended: 0 a path, 1 iterations used up, 2 time used up, 3 cancelled")
      .def("rerun", &ArmPlanner::rerun, "start"_a.noconvert(), "field"_a, "added"_a, "unpaired"_a, "seconds"_a,
           "iterations"_a, "seed"_a, "The same in a later field with the tree of the last run")
      .def("best", &ArmPlanner::best, "Waypoints (N, J), cost, history (H, 2); from any thread")
      .def("look_at", &ArmPlanner::look_at, "field"_a, "Another field from the next run on; not while one is busy")
      .def("cancel", [](ArmPlanner& self) { self.planner().cancel(); }, "From any thread")
      .def("tree", &ArmPlanner::tree, "Nodes (N, J), parents (N), costs (N) of the last run")
      .def_prop_ro("iterations", [](ArmPlanner& self) { return self.planner().iterations(); })
      .def_prop_ro("edges", [](ArmPlanner& self) { return self.planner().edges(); })
      .def_prop_ro("nodes", [](ArmPlanner& self) { return self.planner().tree() ? self.planner().tree()->size() : 0; })
      .def_prop_ro("bytes", [](ArmPlanner& self) { return self.planner().tree() ? self.planner().tree()->bytes() : 0; });
}
