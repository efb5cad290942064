// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdio>
#include <cstdlib>
#include <string>

inline void promise(bool kept, const std::string& what) {
  if (!kept) {
    std::fprintf(stderr, "broken: %s\n", what.c_str());
    std::exit(1);
  }
}

void check_cameras(const std::string& isa);
void check_planning();
void check_collision(const std::string& isa);
void check_path_speed();
void check_depth();
void check_measurements();
void check_bench();
