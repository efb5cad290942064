// SPDX-License-Identifier: Apache-2.0
// How fast a path can be followed under limits of velocity and acceleration.
#pragma once

#include <cstddef>
#include <span>

namespace splatbot {

// A path q(s) at N places s, not decreasing, of J joints.
struct PathShape {
  std::span<const double> s;       // (N,)
  std::span<const double> first;   // (N, J): dq/ds
  std::span<const double> second;  // (N, J): d2q/ds2
  std::span<const double> velocity, acceleration;  // (J,) limits, above 0
};

// The fastest squared speeds (ds/dt)^2 at the places, at rest at both ends, such that |dq/dt| and |d2q/dt2| respect
// the limits everywhere. Reachability analysis on the path (Pham and Pham, TOPP-RA, T-RO 2018). A backward pass
// finds
// the speeds from which the end is reachable, a forward pass takes the largest. Throws std::invalid_argument if sizes
// do not fit.
void fastest_speeds(const PathShape& path, std::span<double> squared);

}  // namespace splatbot
