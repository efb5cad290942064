// SPDX-License-Identifier: Apache-2.0
#include "splatbot/arm.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <stdexcept>

#include "splatbot/arm_groups.hpp"
#include "splatbot/kernels.hpp"
#include "splatbot/threads.hpp"

namespace splatbot {

namespace {

constexpr std::size_t kFewest = 16;

template <class Ask>
void in_parts(std::size_t count, std::size_t fewest, Ask&& ask) {
  const auto pool = thread_pool();
  const std::size_t part = (std::max(fewest, count / (8 * pool->size()) + 1) + 15) / 16 * 16;
  pool->run((count + part - 1) / part, [&](std::size_t i) { ask(i * part, std::min(count, (i + 1) * part)); });
}

void require(bool ok, const char* what) {
  if (!ok) {
    throw std::invalid_argument(what);
  }
}

float rounded_up(double x) {
  const auto f = static_cast<float>(x);
  return static_cast<double>(f) < x ? std::nextafter(f, std::numeric_limits<float>::infinity()) : f;
}

const SolidsView* solids_of(const CollisionField* field) { return field != nullptr ? &field->view() : nullptr; }

double norm(const double* v) { return std::hypot(v[0], v[1], v[2]); }

}  // namespace

Arm::Arm(const ArmSpec& spec) {
  const std::size_t joints = spec.prismatic.size(), spheres = spec.link.size(), pairs = spec.pairs.size() / 2;
  require(joints >= 1 && joints <= kMostJoints, "an arm has 1 to 16 joints");
  require(spheres <= kMostSpheres, "an arm has at most 640 spheres");
  require(pairs <= kMostPairs, "an arm has at most 256 pairs of links that may not touch");
  require(spec.joints.size() == 12 * joints && spec.travel.size() == joints, "joints, kinds and travel differ in number");
  require(spec.centers.size() == 3 * spheres && spec.radii.size() == spheres, "links, centres and radii differ in number");
  require(spec.margin >= 0.0, "the margin is negative");
  require(spec.base.size() == 12, "the base is not a pose");
  exact_.resize(joints);
  joint_.resize(joints);
  for (std::size_t j = 0; j < joints; ++j) {
    const double* T = spec.joints.data() + 12 * j;
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t k = 0; k < 3; ++k) {
        exact_[j].R[3 * i + k] = T[4 * i + k];
        joint_[j].R[3 * i + k] = static_cast<float>(T[4 * i + k]);
      }
      exact_[j].t[i] = T[4 * i + 3];
      joint_[j].t[i] = static_cast<float>(T[4 * i + 3]);
    }
    exact_[j].prismatic = spec.prismatic[j] != 0;
    joint_[j].prismatic = spec.prismatic[j] != 0 ? 1 : 0;
  }
  std::copy(spec.base.begin(), spec.base.end(), base_);
  link_.assign(spec.link.begin(), spec.link.end());
  exact_centers_.assign(spec.centers.begin(), spec.centers.end());
  exact_radii_.assign(spec.radii.begin(), spec.radii.end());
  for (std::size_t i = 0; i < spheres; ++i) {
    require(link_[i] >= 0 && link_[i] <= static_cast<std::int32_t>(joints), "a sphere is on a link that is not there");
    require(i == 0 || link_[i - 1] <= link_[i], "spheres are not sorted by link");
    require(spec.radii[i] >= 0.0, "a radius is negative");
  }
  groups_ = group_spheres(spec.link, spec.centers, spec.radii, joints);
  const std::size_t balls = spheres + groups_.link.size();
  radius_.resize(balls + kPadding);
  for (auto& axis : center_) {
    axis.resize(balls + kPadding);
  }
  reach_.assign(balls * joints, 0.0F);
  link_reach_.assign((joints + 1) * joints, 0.0F);
  for (std::size_t i = 0; i < balls; ++i) {
    const bool small = i < spheres;
    const std::size_t own = small ? static_cast<std::size_t>(groups_.name[i]) : i - spheres;
    const double* center = small ? &spec.centers[3 * own] : &groups_.centers[3 * own];
    radius_[i] = rounded_up((small ? spec.radii[own] : groups_.radii[own]) + kArmRounding);
    for (std::size_t k = 0; k < 3; ++k) {
      center_[k][i] = static_cast<float>(center[k]);
    }
    // Largest distance from each axis: the sum of the following offsets' lengths, the first one only across the axis.
    const auto link = static_cast<std::size_t>(small ? link_[own] : groups_.link[own]);
    double beyond = norm(center);
    double across = std::hypot(center[0], center[1]);
    for (std::size_t j = link; j-- > 0;) {
      const double reach = exact_[j].prismatic ? 1.0 : across;
      reach_[i * joints + j] = rounded_up(reach * (1.0 + 1e-6));
      if (small) {
        float& most = link_reach_[link * joints + j];
        most = std::max(most, reach_[i * joints + j]);
      }
      const double travel = exact_[j].prismatic ? spec.travel[j] : 0.0;
      across = std::hypot(exact_[j].t[0], exact_[j].t[1]) + beyond + travel;
      beyond += norm(exact_[j].t) + travel;
    }
  }
  enclosing_.assign(4 * (joints + 1), -1.0F);
  for (std::size_t l = 0; l <= joints; ++l) {
    const auto first = static_cast<std::size_t>(groups_.link_begin[l]);
    const auto last = static_cast<std::size_t>(groups_.link_begin[l + 1]);
    if (first == last) {
      continue;
    }
    const std::span<const std::int32_t> own(groups_.name.data() + groups_.begin[first],
                                            static_cast<std::size_t>(groups_.begin[last] - groups_.begin[first]));
    double middle[3];
    const double radius = enclosing_ball(own, spec.centers, spec.radii, middle);
    for (std::size_t k = 0; k < 3; ++k) {
      enclosing_[4 * l + k] = static_cast<float>(middle[k]);
    }
    enclosing_[4 * l + 3] = rounded_up(radius + 3.0 * kArmRounding);
  }
  for (std::size_t p = 0; p < pairs; ++p) {
    const std::int32_t a = std::min(spec.pairs[2 * p], spec.pairs[2 * p + 1]);
    const std::int32_t b = std::max(spec.pairs[2 * p], spec.pairs[2 * p + 1]);
    require(a >= 0 && a < b && b <= static_cast<std::int32_t>(joints), "a pair names a link that is not there, or one twice");
    if (enclosing_[4 * static_cast<std::size_t>(a) + 3] >= 0.0F && enclosing_[4 * static_cast<std::size_t>(b) + 3] >= 0.0F) {
      pairs_.insert(pairs_.end(), {a, b});
    } else {
      throw std::invalid_argument("a pair names a link without spheres");
    }
  }
  view_.joints = static_cast<int>(joints);
  view_.spheres = static_cast<int>(spheres);
  view_.groups = static_cast<int>(groups_.link.size());
  view_.first_group = spec.base_in_map ? 0 : groups_.link_begin[1];
  view_.joint = joint_.data();
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 3; ++k) {
      view_.base_R[3 * i + k] = static_cast<float>(base_[4 * i + k]);
    }
    view_.base_t[i] = base_[4 * i + 3];
    view_.center[i] = center_[i].data();
  }
  view_.radius = radius_.data();
  view_.margin = rounded_up(spec.margin);
  view_.name = groups_.name.data();
  view_.group_begin = groups_.begin.data();
  view_.group_link = groups_.link.data();
  view_.link_begin = groups_.link_begin.data();
  view_.enclosing = enclosing_.data();
  view_.pairs = static_cast<int>(pairs);
  view_.pair = pairs_.data();
  view_.reach = reach_.data();
  view_.link_reach = link_reach_.data();
}

void Arm::forward_one(const double* q, double* poses) const {
  std::copy(base_, base_ + 12, poses);
  std::fill(poses + 12, poses + 15, 0.0);
  poses[15] = 1.0;
  for (std::size_t j = 0; j < exact_.size(); ++j) {
    const double* from = poses + 16 * j;
    double* to = poses + 16 * (j + 1);
    const Joint& joint = exact_[j];
    const double c = joint.prismatic ? 1.0 : std::cos(q[j]), s = joint.prismatic ? 0.0 : std::sin(q[j]);
    const double along = joint.prismatic ? q[j] : 0.0;
    for (int i = 0; i < 3; ++i) {
      double row[3];
      for (int k = 0; k < 3; ++k) {
        row[k] = from[4 * i] * joint.R[k] + from[4 * i + 1] * joint.R[3 + k] + from[4 * i + 2] * joint.R[6 + k];
      }
      to[4 * i] = c * row[0] + s * row[1];
      to[4 * i + 1] = c * row[1] - s * row[0];
      to[4 * i + 2] = row[2];
      to[4 * i + 3] = from[4 * i] * joint.t[0] + from[4 * i + 1] * joint.t[1] + from[4 * i + 2] * joint.t[2] +
                      from[4 * i + 3] + row[2] * along;
    }
    std::fill(to + 12, to + 15, 0.0);
    to[15] = 1.0;
  }
}

void Arm::forward(std::span<const double> q, std::span<double> poses) const {
  const std::size_t n = exact_.size(), stride = 16 * (n + 1);
  in_parts(q.size() / n, 256, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      forward_one(q.data() + i * n, poses.data() + i * stride);
    }
  });
}

void Arm::place(const double* poses, std::int32_t link, const double* center, double* at) {
  const double* T = poses + 16 * static_cast<std::size_t>(link);
  for (std::size_t k = 0; k < 3; ++k) {
    at[k] = T[4 * k] * center[0] + T[4 * k + 1] * center[1] + T[4 * k + 2] * center[2] + T[4 * k + 3];
  }
}

void Arm::centers(std::span<const double> q, std::span<double> out) const {
  const std::size_t n = exact_.size(), spheres = link_.size();
  in_parts(q.size() / n, 64, [&](std::size_t begin, std::size_t end) {
    double poses[16 * (kMostJoints + 1)];
    for (std::size_t i = begin; i < end; ++i) {
      forward_one(q.data() + i * n, poses);
      for (std::size_t s = 0; s < spheres; ++s) {
        place(poses, link_[s], &exact_centers_[3 * s], out.data() + 3 * (i * spheres + s));
      }
    }
  });
}

void Arm::centers_float(std::span<const double> q, std::span<float> out) const {
  const ArmKernels& k = *kernels().arm;
  in_parts(q.size() / exact_.size(), 64, [&](std::size_t begin, std::size_t end) {
    k.centers(view_, q.data(), begin, end, out.data());
  });
}

void Arm::configurations(const CollisionField* field, std::span<const double> q, std::span<std::int32_t> verdict) const {
  const ArmKernels& k = *kernels().arm;
  in_parts(verdict.size(), 64, [&](std::size_t begin, std::size_t end) {
    k.configurations(view_, solids_of(field), q.data(), begin, end, verdict.data());
  });
}

void Arm::certify(const CollisionField* field, std::span<const double> from, std::span<const double> to, float eps,
                  std::span<ArmEdge> out) const {
  const ArmKernels& k = *kernels().arm;
  in_parts(out.size(), kFewest, [&](std::size_t begin, std::size_t end) {
    k.certify(view_, solids_of(field), from.data(), to.data(), eps, begin, end, out.data());
  });
}

void Arm::sample(const CollisionField* field, std::span<const double> from, std::span<const double> to, int samples,
                 std::span<ArmEdge> out) const {
  const ArmKernels& k = *kernels().arm;
  in_parts(out.size(), kFewest, [&](std::size_t begin, std::size_t end) {
    k.sample(view_, solids_of(field), from.data(), to.data(), samples, begin, end, out.data());
  });
}

void Arm::clearance(const CollisionField& field, std::span<const double> q, double cut,
                    std::span<ArmClearance> out) const {
  in_parts(out.size(), kFewest, [&](std::size_t begin, std::size_t end) {
    double poses[16 * (kMostJoints + 1)];
    for (std::size_t i = begin; i < end; ++i) {
      forward_one(q.data() + i * exact_.size(), poses);
      out[i] = clearance_at(field, poses, cut);
    }
  });
}

ArmClearance Arm::clearance_at(const CollisionField& field, const double* poses, double cut) const {
  const FieldKernels& k = *kernels().field;
  const std::size_t groups = groups_.link.size();
  double at[3 * std::max(kMostGroups, kGroupSize)];
  double least[kMostGroups];  // no sphere of a group has less clearance, as the grid sees it
  float bound[std::max(kMostGroups, kGroupSize)];
  std::size_t order[kMostGroups];
  for (std::size_t g = 0; g < groups; ++g) {
    place(poses, groups_.link[g], &groups_.centers[3 * g], at + 3 * g);
  }
  k.grid_bounds(field.view(), at, 0, groups, bound);
  for (std::size_t g = 0; g < groups; ++g) {
    least[g] = static_cast<double>(bound[g]) - groups_.radii[g];
  }
  const auto first = static_cast<std::size_t>(view_.first_group);
  std::iota(order + first, order + groups, first);
  std::sort(order + first, order + groups, [&](std::size_t a, std::size_t b) { return least[a] < least[b]; });
  ArmClearance best = {std::numeric_limits<double>::infinity(), {0, 0, 0}, {0, 0, 0}, -1, -1};
  const auto margin = static_cast<double>(view_.margin);
  for (std::size_t o = first; o < groups; ++o) {  // nearest first: later ones need look less far
    const std::size_t g = order[o];
    if (least[g] - margin > std::min(cut, best.distance)) {
      break;
    }
    const auto from = static_cast<std::size_t>(groups_.begin[g]), to = static_cast<std::size_t>(groups_.begin[g + 1]);
    for (std::size_t s = from; s < to; ++s) {
      place(poses, groups_.link[g], &exact_centers_[3 * static_cast<std::size_t>(groups_.name[s])], at + 3 * (s - from));
    }
    k.grid_bounds(field.view(), at, 0, to - from, bound);
    for (std::size_t s = from; s < to; ++s) {
      const double* center = at + 3 * (s - from);
      const double radius = exact_radii_[static_cast<std::size_t>(groups_.name[s])] + margin;
      const double reach = std::min(cut, best.distance) + radius;
      if (reach >= 0.0 && static_cast<double>(bound[s - from]) > reach) {
        continue;
      }
      NearestSolid found;
      k.nearest(field.view(), {center, nullptr}, rounded_up(std::max(reach, 0.0)), 0, 1, &found);
      if (found.id >= 0 && found.distance - radius < best.distance && found.distance - radius <= cut) {
        best.distance = found.distance - radius;
        std::copy(std::begin(found.normal), std::end(found.normal), best.normal);
        std::copy_n(center, 3, best.center);
        best.sphere = groups_.name[s];
        best.id = found.id;
      }
    }
  }
  return best;
}

}  // namespace splatbot
