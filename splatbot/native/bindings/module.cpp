// SPDX-License-Identifier: Apache-2.0
#include <nanobind/nanobind.h>

namespace nb = nanobind;

// Each concept's bindings live in a file of their own and are entered here.
void define_rasterize(nb::module_& m);

NB_MODULE(_native, m) {
  m.doc() = "splatbot's C++ core";
  nb::set_leak_warnings(false);  // a render kept until the interpreter exits is no leak
  define_rasterize(m);
}
