// SPDX-License-Identifier: Apache-2.0
// What module.cpp enters into the Python module: one function a concept.
#pragma once

#include <nanobind/nanobind.h>

void define_align(nanobind::module_& m);
void define_arm(nanobind::module_& m);
void define_baseline(nanobind::module_& m);
void define_depth(nanobind::module_& m);
void define_field(nanobind::module_& m);
void define_matching(nanobind::module_& m);
void define_optimize(nanobind::module_& m);
void define_path_speed(nanobind::module_& m);
void define_planning(nanobind::module_& m);
void define_rasterize(nanobind::module_& m);
void define_lens(nanobind::module_& m);
void define_surfels(nanobind::module_& m);
