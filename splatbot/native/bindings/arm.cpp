// SPDX-License-Identifier: Apache-2.0
#include "splatbot/arm.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>

#include "arrays.hpp"
#include "bindings.hpp"

using namespace nb::literals;

namespace {

using splatbot::Arm;
using splatbot::ArmClearance;
using splatbot::ArmEdge;
using splatbot::CollisionField;
using Joints = Array<const double, nb::shape<-1, 3, 4>>;
using Kinds = Array<const std::uint8_t, nb::shape<-1>>;
using Numbers = Array<const double, nb::shape<-1>>;
using Links = Array<const std::int32_t, nb::shape<-1>>;
using Pairs = Array<const std::int32_t, nb::shape<-1, 2>>;
using Points = Array<const double, nb::shape<-1, 3>>;
using Base = Array<const double, nb::shape<3, 4>>;
using Configurations = Array<const double, nb::shape<-1, -1>>;

void check(const Arm& arm, const Configurations& q) {
  if (q.shape(1) != static_cast<std::size_t>(arm.joints())) {
    throw nb::value_error("configurations have another number of joints");
  }
}

// Three numbers for each sphere of each configuration: (C, S, 3).
template <class T, class Fill>
nb::ndarray<nb::numpy, T> of_spheres(const Arm& arm, const Configurations& q, Fill&& fill) {
  check(arm, q);
  return filled<T>({q.shape(0), static_cast<std::size_t>(arm.spheres()), 3}, fill);
}

template <class Ask>
nb::tuple edges(const Arm& arm, const Configurations& from, const Configurations& to, Ask&& ask) {
  check(arm, from);
  check(arm, to);
  if (from.shape(0) != to.shape(0)) {
    throw nb::value_error("the edges' ends differ in number");
  }
  std::vector<ArmEdge> out(from.shape(0));
  {
    nb::gil_scoped_release release;
    ask(std::span<ArmEdge>(out));
  }
  return nb::make_tuple(column(out, &ArmEdge::verdict), column(out, &ArmEdge::at), column(out, &ArmEdge::checked));
}

}  // namespace

void define_arm(nb::module_& m) {
  m.attr("ARM_SELF") = static_cast<int>(splatbot::kArmSelf);
  m.attr("ARM_ROUNDING") = splatbot::kArmRounding;
  nb::class_<Arm>(m, "Arm", "A serial arm of spheres; immutable")
      .def(
          "__init__",
          [](Arm* self, Joints joints, Kinds prismatic, Numbers travel, Links link, Points centers, Numbers radii,
             Pairs pairs, Base base, bool base_in_map, double margin) {
            new (self) Arm({span_of(joints), span_of(prismatic), span_of(travel), span_of(link), span_of(centers),
                            span_of(radii), span_of(pairs), span_of(base), base_in_map, margin});
          },
          nb::kw_only(), "joints"_a.noconvert(), "prismatic"_a.noconvert(), "travel"_a.noconvert(),
          "link"_a.noconvert(), "centers"_a.noconvert(), "radii"_a.noconvert(), "pairs"_a.noconvert(),
          "base"_a.noconvert(), "base_in_map"_a, "margin"_a = 0.0)
      .def(
          "forward",
          [](const Arm& self, Configurations q) {
            check(self, q);
            const std::size_t n = q.shape(0), links = static_cast<std::size_t>(self.joints()) + 1;
            return filled<double>({n, links, 4, 4}, [&](std::span<double> out) { self.forward(span_of(q), out); });
          },
          "q"_a.noconvert(), "T_world_link (C, J + 1, 4, 4)")
      .def(
          "centers",
          [](const Arm& self, Configurations q) {
            return of_spheres<double>(self, q, [&](std::span<double> out) { self.centers(span_of(q), out); });
          },
          "q"_a.noconvert(), "Centres of the spheres (C, S, 3) in float64")
      .def(
          "centers_float",
          [](const Arm& self, Configurations q) {
            return of_spheres<float>(self, q, [&](std::span<float> out) { self.centers_float(span_of(q), out); });
          },
          "q"_a.noconvert(), "The same as the kernels see them, in float32")
      .def(
          "reach",
          [](const Arm& self) {
            const splatbot::ArmView& view = self.view();
            const auto spheres = static_cast<std::size_t>(view.spheres), joints = static_cast<std::size_t>(view.joints);
            std::vector<float> reach(spheres * joints);
            for (std::size_t i = 0; i < spheres; ++i) {
              std::copy_n(view.reach + i * joints, joints, &reach[static_cast<std::size_t>(view.name[i]) * joints]);
            }
            return owned(std::move(reach), {spheres, joints});
          },
          "The farthest that each sphere's centre can be from each joint's axis (S, J) [m]; 1 for joints that slide")
      .def(
          "configurations",
          [](const Arm& self, const CollisionField* field, Configurations q) {
            check(self, q);
            return filled<std::int32_t>({q.shape(0)}, [&](std::span<std::int32_t> verdict) {
              self.configurations(field, span_of(q), verdict);
            });
          },
          "field"_a.none(), "q"_a.noconvert(), "Verdicts (C): -1 free, a sphere, or ARM_SELF + a pair")
      .def(
          "certify",
          [](const Arm& self, const CollisionField* field, Configurations from, Configurations to, float eps) {
            return edges(self, from, to, [&](std::span<ArmEdge> out) {
              self.certify(field, span_of(from), span_of(to), eps, out);
            });
          },
          "field"_a.none(), "from_"_a.noconvert(), "to"_a.noconvert(), "eps"_a,
          "Verdict, place and number of configurations (E) of edges checked all along")
      .def(
          "sample",
          [](const Arm& self, const CollisionField* field, Configurations from, Configurations to, int samples) {
            if (samples < 1 || samples > (1 << 20)) {
              throw nb::value_error("samples is not in 1..2^20");
            }
            return edges(self, from, to, [&](std::span<ArmEdge> out) {
              self.sample(field, span_of(from), span_of(to), samples, out);
            });
          },
          "field"_a.none(), "from_"_a.noconvert(), "to"_a.noconvert(), "samples"_a)
      .def(
          "clearance",
          [](const Arm& self, const CollisionField& field, Configurations q, double cut) {
            check(self, q);
            std::vector<ArmClearance> out(q.shape(0));
            {
              nb::gil_scoped_release release;
              self.clearance(field, span_of(q), cut, out);
            }
            return nb::make_tuple(column(out, &ArmClearance::distance), column(out, &ArmClearance::normal),
                                  column(out, &ArmClearance::center), column(out, &ArmClearance::sphere),
                                  column(out, &ArmClearance::id));
          },
          "field"_a, "q"_a.noconvert(), "cut"_a,
          "Clearance (C), its gradient at the sphere (C, 3), the sphere's centre (C, 3), sphere and id");
}
