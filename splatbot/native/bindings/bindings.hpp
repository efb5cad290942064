// SPDX-License-Identifier: Apache-2.0
// Functions by which module.cpp fills the Python module, one for each concept.
#pragma once

#include <nanobind/nanobind.h>

void define_align(nanobind::module_& m);
void define_arm(nanobind::module_& m);
void define_depth(nanobind::module_& m);
void define_field(nanobind::module_& m);
void define_matching(nanobind::module_& m);
void define_measurements(nanobind::module_& m);
void define_optimize(nanobind::module_& m);
void define_path_speed(nanobind::module_& m);
void define_planning(nanobind::module_& m);
void define_rasterize(nanobind::module_& m);
void define_lens(nanobind::module_& m);
void define_surfels(nanobind::module_& m);
