// SPDX-License-Identifier: Apache-2.0
#include "bindings.hpp"
#include "splatbot/memory.hpp"

NB_MODULE(_native, m) {
  m.doc() = "splatbot's C++ core";
  nanobind::set_leak_warnings(false);  // a render kept until the interpreter exits is no leak
  splatbot::keep_freed_memory();
  define_align(m);
  define_arm(m);
  define_depth(m);
  define_field(m);
  define_matching(m);
  define_measurements(m);
  define_optimize(m);
  define_path_speed(m);
  define_planning(m);
  define_rasterize(m);
  define_lens(m);
  define_surfels(m);
}
