// SPDX-License-Identifier: Apache-2.0
#include <nanobind/nanobind.h>

namespace nb = nanobind;

// Each concept's bindings live in a file of their own and are entered here.

NB_MODULE(_native, m) {
  m.doc() = "splatbot's C++ core";
}
