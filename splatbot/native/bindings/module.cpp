// SPDX-License-Identifier: Apache-2.0
#include "bindings.hpp"

NB_MODULE(_native, m) {
  m.doc() = "splatbot's C++ core";
  define_align(m);
}
