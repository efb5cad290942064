// SPDX-License-Identifier: Apache-2.0
#include "splatbot/path_speed.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "arrays.hpp"
#include "bindings.hpp"

using namespace nb::literals;

namespace {

using Column = Array<const double, nb::shape<-1>>;
using Table = Array<const double, nb::shape<-1, -1>>;

}  // namespace

void define_path_speed(nb::module_& m) {
  m.def(
      "fastest_speeds",
      [](Column s, Table first, Table second, Column velocity, Column acceleration) {
        return filled<double>({s.shape(0)}, [&](std::span<double> squared) {
          splatbot::fastest_speeds(
              {span_of(s), span_of(first), span_of(second), span_of(velocity), span_of(acceleration)}, squared);
        });
      },
      "s"_a.noconvert(), "first"_a.noconvert(), "second"_a.noconvert(), "velocity"_a.noconvert(),
      "acceleration"_a.noconvert(), "Squared path speeds (N) under limits of velocity and acceleration");
}
