// SPDX-License-Identifier: Apache-2.0
// An arm of spheres against the collision field and against itself.
#include "arm_entry.hpp"
#include "arm_lanes.hpp"
#include "solid_tree.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

constexpr std::uint32_t kAllLanes = W == 32 ? ~0U : (1U << W) - 1U;

SB_INLINE Split split_of(const ArmView& arm, const float (&at)[3][W], int lane) {
  double p[3];
  for (int k = 0; k < 3; ++k) {
    p[k] = arm.base_t[k] + static_cast<double>(at[k][lane]);
  }
  return split(p);
}

// The lanes in `wanted` for which the grid does not prove that a ball of radius r (by lane) is free.
SB_INLINE std::uint32_t not_proven(const ArmView& arm, const BoundGridView& g, const float (&at)[3][W], F r,
                                   std::uint32_t wanted) {
  if (g.bound == nullptr) {
    return wanted;
  }
  F from[3];
  for (int k = 0; k < 3; ++k) {
    from[k] = load(at[k]) + set1(static_cast<float>(arm.base_t[k] - static_cast<double>(g.origin[k])));
  }
  const F x = from[0] * set1(g.per_voxel), y = from[1] * set1(g.per_voxel), z = from[2] * set1(g.per_voxel);
  const F zero = set1(0.0F);
  const M inside = (x >= zero) & (y >= zero) & (z >= zero) & (x < set1(static_cast<float>(g.size[0]))) &
                   (y < set1(static_cast<float>(g.size[1]))) & (z < set1(static_cast<float>(g.size[2])));
  // Voxels that the ball needs, enlarged by the rounding error of its centre.
  const F most = max(absolute(from[0]), max(absolute(from[1]), absolute(from[2]))) + set1(4.0F);  // and of the arm
  const F need = fma(most, set1(8e-7F), r) * set1(g.per_voxel * (1.0F + 2e-5F));
  alignas(64) float needed[W];
  alignas(64) std::uint32_t ix[W], iy[W], iz[W];
  store(needed, need * need);
  store(ix, to_int(zero_unless(inside, x)));
  store(iy, to_int(zero_unless(inside, y)));
  store(iz, to_int(zero_unless(inside, z)));
  const std::uint32_t known = bits(inside) & wanted;
  std::uint32_t open = wanted & ~known;
  for (std::uint32_t m = known; m != 0; m &= m - 1) {
    const int i = __builtin_ctz(m);
    const std::size_t cell =
        (static_cast<std::size_t>(iz[i]) * static_cast<std::size_t>(g.size[1]) + static_cast<std::size_t>(iy[i])) *
            static_cast<std::size_t>(g.size[0]) +
        static_cast<std::size_t>(ix[i]);
    open |= static_cast<std::uint32_t>(!(static_cast<float>(g.bound[cell]) > needed[i])) << i;
  }
  return open;
}

// The lanes in `lanes` where two balls of the same arm, grown by `more`, meet.
SB_INLINE std::uint32_t meeting(const ArmView& arm, const Placed& placed, int a, int b, F more, std::uint32_t lanes) {
  const F reach = set1(arm.radius[a] + arm.radius[b]) + more;
  return lanes & bits(squared_between(placed.at[a], placed.at[b]) <= reach * reach);
}

// Calls visit(group, group, lanes) for each two groups of a pair of links that may meet. It returns the lanes that
// remain.
template <class Visit>
SB_INLINE void meeting_groups(const ArmView& arm, const Pose* link, Placed& placed, int pair, F more,
                              std::uint32_t lanes, Visit&& visit) {
  const int a = arm.pair[2 * pair], b = arm.pair[2 * pair + 1];
  const F near = set1(arm.enclosing[4 * a + 3] + arm.enclosing[4 * b + 3]) + more;
  std::uint32_t close = lanes & bits(squared_between(placed.ball[a], placed.ball[b]) <= near * near);
  for (int g = arm.link_begin[a]; g < arm.link_begin[a + 1] && close != 0; ++g) {
    const F wide = set1(arm.radius[arm.spheres + g] + arm.enclosing[4 * b + 3]) + more;
    if ((close & bits(squared_between(placed.at[arm.spheres + g], placed.ball[b]) <= wide * wide)) == 0) {
      continue;
    }
    for (int h = arm.link_begin[b]; h < arm.link_begin[b + 1] && close != 0; ++h) {
      const std::uint32_t met = meeting(arm, placed, arm.spheres + g, arm.spheres + h, more, close);
      if (met != 0) {
        place_spheres(arm, link, g, placed);
        place_spheres(arm, link, h, placed);
        close &= visit(g, h, met) | ~met;
      }
    }
  }
}

// Verdicts of the lanes: those still free are in the answer.
SB_INLINE std::uint32_t check_self(const ArmView& arm, const Pose* link, Placed& placed, std::uint32_t alive,
                                   std::int32_t* verdict) {
  const F zero = set1(0.0F);
  for (int k = 0; k < arm.pairs && alive != 0; ++k) {
    meeting_groups(arm, link, placed, k, zero, alive, [&](int g, int h, std::uint32_t lanes) {
      for (int s = arm.group_begin[g]; s < arm.group_begin[g + 1] && lanes != 0; ++s) {
        if (meeting(arm, placed, s, arm.spheres + h, zero, lanes) == 0) {
          continue;
        }
        for (int t = arm.group_begin[h]; t < arm.group_begin[h + 1]; ++t) {
          std::uint32_t met = meeting(arm, placed, s, t, zero, lanes);
          alive &= ~met;
          lanes &= ~met;
          for (; met != 0; met &= met - 1) {
            verdict[__builtin_ctz(met)] = kArmSelf + k;
          }
        }
      }
      return lanes;
    });
  }
  return alive;
}

// Calls visit(first sphere, number, their places) for the spheres of a group in one lane, up to W at a time.
template <class Visit>
SB_INLINE void in_lane(const ArmView& arm, const Placed& placed, int group, int lane, Visit&& visit) {
  alignas(64) float at[3][W];
  for (int first = arm.group_begin[group], end = arm.group_begin[group + 1]; first < end; first += W) {
    const int count = end - first < W ? end - first : W;
    place_in_lane(arm, placed, arm.group_link[group], lane, first, at);
    visit(first, count == W ? kAllLanes : (1U << count) - 1U, at);
  }
}

// A sphere of a group that may touch the map in one lane; -1: none.
SB_INLINE int touching(const ArmView& arm, const SolidsView& field, const Placed& placed, int group, int lane) {
  int found = -1;
  in_lane(arm, placed, group, lane, [&](int first, std::uint32_t all, const float(&at)[3][W]) {
    const F radius = load(arm.radius + first) + set1(arm.margin);
    for (std::uint32_t open = found < 0 ? not_proven(arm, field.grid, at, radius, all) : 0; open != 0; open &= open - 1) {
      const int i = __builtin_ctz(open);
      if (tree_hit(field, split_of(arm, at, i), arm.radius[first + i] + arm.margin)) {
        found = first + i;
        return;
      }
    }
  });
  return found;
}

SB_INLINE std::uint32_t check_field(const ArmView& arm, const SolidsView& field, const Placed& placed, std::uint32_t alive,
                                    std::int32_t* verdict) {
  for (int g = arm.groups - 1; g >= arm.first_group && alive != 0; --g) {  // the hand first
    const int ball = arm.spheres + g;
    const std::uint32_t near = not_proven(arm, field.grid, placed.at[ball], set1(arm.radius[ball] + arm.margin), alive);
    if (near == 0) {
      continue;
    }
    for (std::uint32_t m = near; m != 0; m &= m - 1) {
      const int lane = __builtin_ctz(m);
      if (!tree_hit(field, split_of(arm, placed.at[ball], lane), arm.radius[ball] + arm.margin)) {
        continue;
      }
      const int hit = touching(arm, field, placed, g, lane);
      if (hit >= 0) {
        alive &= ~(1U << lane);
        verdict[lane] = arm.name[hit];
      }
    }
  }
  return alive;
}

// The verdicts of up to W configurations; returns the lanes that are free.
std::uint32_t check_lanes(const ArmView& arm, const SolidsView* field, const JointLanes& q, std::uint32_t alive,
                          std::int32_t* verdict) {
  Pose link[kMostJoints + 1];
  Placed placed;
  forward(arm, q, link);
  place_groups(arm, link, placed);
  for (int i = 0; i < W; ++i) {
    verdict[i] = kArmFree;
  }
  alive = check_self(arm, link, placed, alive, verdict);
  return field == nullptr ? alive : check_field(arm, *field, placed, alive, verdict);
}

// A stretch of an edge: its middle, half its length, and the spheres not yet known to be free on it.
struct Stretch {
  float middle, half;
  std::uint64_t spheres[kMostSpheres / 64];
  std::uint64_t pairs[kMostPairs / 64];
};

SB_INLINE bool has(const std::uint64_t* set, int i) { return ((set[i / 64] >> (i % 64)) & 1U) != 0; }
SB_INLINE std::uint32_t some(const std::uint64_t* set, int first, int count) {  // a bit each, 32 at most
  const int word = first / 64, bit = first % 64;
  std::uint64_t found = set[word] >> bit;
  if (bit > 32 && word + 1 < kMostSpheres / 64) {
    found |= set[word + 1] << (64 - bit);
  }
  return static_cast<std::uint32_t>(found & ((std::uint64_t{1} << count) - 1U));
}
SB_INLINE void add(std::uint64_t* set, int i) { set[i / 64] |= std::uint64_t{1} << (i % 64); }

constexpr int kFirst = 16;       // stretches that an edge is cut into at once
constexpr int kWaiting = 16384;  // stretches that may wait; an edge that needs more is rejected

// Bounds of how the arm moves along an edge q(t) = q0 + t d.
struct Motion {
  float speed[kMostJoints];            // |d_j|
  float bend[kMostBalls + kPadding];   // of c''(t): sum_k reach_k |d_k| (|d_k| + 2 sum_{j<k} |d_j|)
  float apart[kMostPairs];             // of the relative speed of two links
};

void bound_motion(const ArmView& arm, const double* from, const double* to, Motion& motion) {
  for (int j = 0; j < arm.joints; ++j) {
    const double d = to[j] - from[j];
    motion.speed[j] = static_cast<float>(d < 0.0 ? -d : d) * (1.0F + 1e-6F);
  }
  for (int s = 0; s < arm.spheres + arm.groups; ++s) {
    float sum = 0.0F, before = 0.0F;
    for (int k = 0; k < arm.joints; ++k) {
      sum += arm.reach[s * arm.joints + k] * motion.speed[k] * (motion.speed[k] + 2.0F * before);
      before += motion.speed[k];
    }
    motion.bend[s] = sum * (1.0F + 1e-5F);
  }
  for (int p = 0; p < arm.pairs; ++p) {
    const int a = arm.pair[2 * p], b = arm.pair[2 * p + 1];
    float sum = 0.0F;
    for (int j = a; j < b; ++j) {  // joint j moves link j + 1: those between the two links
      sum += arm.link_reach[b * arm.joints + j] * motion.speed[j];
    }
    motion.apart[p] = sum * (1.0F + 1e-5F);
  }
}

// Velocity of each link's frame along the edge: c' = omega x c + u.
struct Twist {
  F omega[3], u[3];
};

SB_INLINE void twists(const ArmView& arm, const Pose* link, const float* d, Twist* twist) {
  for (int i = 0; i < 3; ++i) {
    twist[0].omega[i] = set1(0.0F);
    twist[0].u[i] = set1(0.0F);
  }
  for (int j = 0; j < arm.joints; ++j) {
    const Pose& pose = link[j + 1];
    const F rate = set1(d[j]);
    const F z[3] = {pose.R[2] * rate, pose.R[5] * rate, pose.R[8] * rate};
    for (int i = 0; i < 3; ++i) {
      twist[j + 1] = i == 0 ? twist[j] : twist[j + 1];
      const int a = (i + 1) % 3, b = (i + 2) % 3;
      if (arm.joint[j].prismatic != 0) {
        twist[j + 1].u[i] = twist[j + 1].u[i] + z[i];
      } else {
        twist[j + 1].omega[i] = twist[j + 1].omega[i] + z[i];
        twist[j + 1].u[i] = twist[j + 1].u[i] - fms(z[a], pose.t[b], z[b] * pose.t[a]);
      }
    }
  }
}

SB_INLINE F speed_of(const Twist& w, const float (&at)[3][W]) {
  F sum = set1(0.0F);
  for (int i = 0; i < 3; ++i) {
    const int a = (i + 1) % 3, b = (i + 2) % 3;
    const F v = fms(w.omega[a], load(at[b]), w.omega[b] * load(at[a])) + w.u[i];
    sum = fma(v, v, sum);
  }
  return sqrt(sum);
}

SB_INLINE float lane_of(F v, int lane) {
  alignas(64) float all[W];
  store(all, v);
  return all[lane];
}

class Certifier {
 public:
  Certifier(const ArmView& arm, const SolidsView* field, float eps, Stretch* waiting)
      : arm_(arm), field_(field), eps_(eps), waiting_(waiting) {}

  ArmEdge run(const double* from, const double* to) {
    bound_motion(arm_, from, to, motion_);
    from_ = from;
    for (int j = 0; j < arm_.joints; ++j) {
      delta_[j] = to[j] - from[j];
      rate_[j] = static_cast<float>(delta_[j]);
    }
    begin();
    edge_ = {kArmFree, 1.0F, 0};
    int head = 0;  // breadth first: coarse stretches come before fine ones, and hits are found early
    while (head < count_ && edge_.verdict == kArmFree) {
      const int n = count_ - head < W ? count_ - head : W;
      round(head, n);
      head += n;
    }
    return edge_;
  }

 private:
  void begin() {
    count_ = kFirst;
    for (int i = 0; i < kFirst; ++i) {
      Stretch& s = waiting_[i];
      s.half = 0.5F / kFirst;
      s.middle = (static_cast<float>(i) + 0.5F) / kFirst;
      std::memset(s.spheres, 0, sizeof(s.spheres));
      std::memset(s.pairs, 0, sizeof(s.pairs));
      for (int k = arm_.group_begin[arm_.first_group]; field_ != nullptr && k < arm_.spheres; ++k) {
        add(s.spheres, k);
      }
      for (int k = 0; k < arm_.pairs; ++k) {
        add(s.pairs, k);
      }
    }
  }

  void reject(std::int32_t verdict, int lane, int head) {
    if (edge_.verdict == kArmFree) {
      edge_.verdict = verdict;
      edge_.at = waiting_[head + lane].middle;
    }
  }

  void round(int head, int n) {
    JointLanes q;
    alignas(64) float half[W];
    for (int i = 0; i < W; ++i) {
      const Stretch& s = waiting_[head + (i < n ? i : 0)];
      half[i] = s.half;
      for (int j = 0; j < arm_.joints; ++j) {
        put_joint(q, j, i, from_[j] + static_cast<double>(s.middle) * delta_[j]);
      }
    }
    edge_.checked += n;
    Twist twist[kMostJoints + 1];
    forward(arm_, q, link_);
    place_groups(arm_, link_, placed_);
    twists(arm_, link_, rate_, twist);
    Stretch left[W];
    std::uint32_t open = 0;
    for (int i = 0; i < n; ++i) {
      std::memset(&left[i], 0, sizeof(Stretch));
    }
    const std::uint32_t lanes = n == W ? kAllLanes : (1U << n) - 1U;
    for (int k = 0; k < arm_.pairs; ++k) {
      open |= pair(k, head, lanes, half, left);
    }
    for (int g = arm_.groups - 1; g >= arm_.first_group && field_ != nullptr && edge_.verdict == kArmFree; --g) {
      open |= group(g, twist, head, lanes, half, left);
    }
    for (int i = 0; i < n && edge_.verdict == kArmFree; ++i) {
      if (((open >> i) & 1U) != 0) {
        halve(head + i, left[i]);
      }
    }
  }

  std::uint32_t wanted(int head, std::uint32_t lanes, int pair) const {
    std::uint32_t w = 0;
    for (std::uint32_t m = lanes; m != 0; m &= m - 1) {
      const int lane = __builtin_ctz(m);
      w |= static_cast<std::uint32_t>(has(waiting_[head + lane].pairs, pair)) << lane;
    }
    return w;
  }

  // The lanes in which a sphere of group g is not yet known to be free all along.
  std::uint32_t group(int g, const Twist* twist, int head, std::uint32_t lanes, const float (&half)[W], Stretch* left) {
    std::uint32_t mine = 0, found = 0;
    const int begin = arm_.group_begin[g], count = arm_.group_begin[g + 1] - begin;
    for (std::uint32_t m = lanes; m != 0; m &= m - 1) {
      const int lane = __builtin_ctz(m);
      mine |= static_cast<std::uint32_t>(some(waiting_[head + lane].spheres, begin, count) != 0) << lane;
    }
    if (mine == 0) {
      return 0;
    }
    const int ball = arm_.spheres + g, link = arm_.group_link[g];
    const F speed = speed_of(twist[link], placed_.at[ball]);
    const F reach = set1(arm_.radius[ball] + arm_.margin) + motion(speed, set1(motion_.bend[ball]), load(half));
    mine = not_proven(arm_, field_->grid, placed_.at[ball], reach, mine);
    alignas(64) float wide[W];
    store(wide, reach);
    for (; mine != 0 && edge_.verdict == kArmFree; mine &= mine - 1) {
      const int lane = __builtin_ctz(mine);
      if (!tree_hit(*field_, split_of(arm_, placed_.at[ball], lane), wide[lane])) {
        continue;
      }
      found |= static_cast<std::uint32_t>(in_stretch(g, twist[link], head, lane, half[lane], left[lane])) << lane;
    }
    return found;
  }

  // Adds the spheres of group g that are not yet known to be free along one stretch to `left`; returns whether there are
  // any.
  bool in_stretch(int g, const Twist& twist, int head, int lane, float half, Stretch& left) {
    bool found = false;
    Twist own;
    for (int i = 0; i < 3; ++i) {
      own.omega[i] = set1(lane_of(twist.omega[i], lane));
      own.u[i] = set1(lane_of(twist.u[i], lane));
    }
    in_lane(arm_, placed_, g, lane, [&](int first, std::uint32_t all, const float(&at)[3][W]) {
      const F moves = motion(speed_of(own, at), load(motion_.bend + first), set1(half));
      const F radius = load(arm_.radius + first) + set1(arm_.margin);
      alignas(64) float room[W];
      store(room, moves);
      const std::uint32_t mine = all & some(waiting_[head + lane].spheres, first, W);
      std::uint32_t open = mine == 0 ? 0 : not_proven(arm_, field_->grid, at, radius + moves, mine);
      for (; open != 0 && edge_.verdict == kArmFree; open &= open - 1) {
        const int i = __builtin_ctz(open), s = first + i;
        const Split p = split_of(arm_, at, i);
        const float own_radius = arm_.radius[s] + arm_.margin;
        if (!tree_hit(*field_, p, own_radius + room[i])) {
          continue;
        }
        if (room[i] <= eps_ || tree_hit(*field_, p, own_radius)) {
          reject(arm_.name[s], lane, head);
          return;
        }
        add(left.spheres, s);
        found = true;
      }
    });
    return found;
  }

  // Bounds the motion of balls from the middle of a stretch: v h + a h² / 2. 2 um cover the rounding of the speed and
  // of the middle in float32.
  static F motion(F speed, F bend, F half) {
    return fma(speed * set1(1.0F + 1e-5F), half, set1(0.5F) * bend * half * half) + set1(2e-6F);
  }

  // The same of a pair of links.
  std::uint32_t pair(int k, int head, std::uint32_t lanes, const float (&half)[W], Stretch* left) {
    const std::uint32_t mine = wanted(head, lanes, k);
    const F moves = fma(set1(motion_.apart[k]), load(half), set1(4e-6F));
    std::uint32_t found = 0;
    meeting_groups(arm_, link_, placed_, k, moves, mine, [&](int g, int h, std::uint32_t near) -> std::uint32_t {
      for (int s = arm_.group_begin[g]; s < arm_.group_begin[g + 1]; ++s) {
        if (meeting(arm_, placed_, s, arm_.spheres + h, moves, near) == 0) {
          continue;
        }
        for (int t = arm_.group_begin[h]; t < arm_.group_begin[h + 1]; ++t) {
          const std::uint32_t doubtful = meeting(arm_, placed_, s, t, moves, near);
          const std::uint32_t hit = doubtful == 0 ? 0 : meeting(arm_, placed_, s, t, set1(0.0F), doubtful);
          const std::uint32_t small = doubtful & bits(moves <= set1(eps_));
          if ((hit | small) != 0) {
            reject(kArmSelf + k, __builtin_ctz(hit | small), head);
            return 0;
          }
          found |= doubtful;
        }
      }
      return near;
    });
    for (std::uint32_t m = edge_.verdict == kArmFree ? found : 0; m != 0; m &= m - 1) {
      add(left[__builtin_ctz(m)].pairs, k);
    }
    return found;
  }

  void halve(int at, const Stretch& left) {
    if (count_ + 2 > kWaiting) {
      edge_.verdict = has_sphere(left);
      edge_.at = waiting_[at].middle;
      return;
    }
    const float half = 0.5F * waiting_[at].half;
    for (int side = 0; side < 2; ++side) {
      Stretch& s = waiting_[count_++];
      s = left;
      s.half = half;
      s.middle = waiting_[at].middle + (side == 0 ? -half : half);
    }
  }

  std::int32_t has_sphere(const Stretch& left) const {
    for (int s = 0; s < arm_.spheres; ++s) {
      if (has(left.spheres, s)) {
        return arm_.name[s];
      }
    }
    for (int k = 0; k < arm_.pairs; ++k) {
      if (has(left.pairs, k)) {
        return kArmSelf + k;
      }
    }
    return 0;
  }

  const ArmView& arm_;
  const SolidsView* field_;
  float eps_;
  Stretch* waiting_;
  int count_ = 0;
  const double* from_ = nullptr;
  double delta_[kMostJoints] = {};
  float rate_[kMostJoints] = {};
  Motion motion_;
  Pose link_[kMostJoints + 1];
  Placed placed_;
  ArmEdge edge_{};
};

// Bit-reversed order of [0, n): far apart first.
SB_INLINE int reversed(int i, int log2) {
  int r = 0;
  for (int b = 0; b < log2; ++b) {
    r |= ((i >> b) & 1) << (log2 - 1 - b);
  }
  return r;
}

// Up to W configurations from `first` on, before `end`; returns their number. The first one fills the other lanes.
SB_INLINE int load_joints(const ArmView& arm, const double* q, std::size_t first, std::size_t end, JointLanes& joints) {
  const int n = end - first < static_cast<std::size_t>(W) ? static_cast<int>(end - first) : W;
  for (int i = 0; i < W; ++i) {
    const double* row = q + (first + static_cast<std::size_t>(i < n ? i : 0)) * static_cast<std::size_t>(arm.joints);
    for (int j = 0; j < arm.joints; ++j) {
      put_joint(joints, j, i, row[j]);
    }
  }
  return n;
}

}  // namespace

void arm_configurations(const ArmView& arm, const SolidsView* field, const double* q, std::size_t begin,
                        std::size_t end, std::int32_t* verdict) {
  std::int32_t lanes[W];
  JointLanes joints;
  for (std::size_t first = begin; first < end; first += W) {
    const int n = load_joints(arm, q, first, end, joints);
    check_lanes(arm, field, joints, n == W ? kAllLanes : (1U << n) - 1U, lanes);
    for (int i = 0; i < n; ++i) {
      verdict[first + static_cast<std::size_t>(i)] = lanes[i];
    }
  }
}

void arm_certify(const ArmView& arm, const SolidsView* field, const double* from, const double* to, float eps,
                 std::size_t begin, std::size_t end, ArmEdge* out) {
  auto* waiting = static_cast<Stretch*>(__builtin_malloc(kWaiting * sizeof(Stretch)));
  Certifier certifier(arm, field, eps, waiting);
  for (std::size_t i = begin; i < end; ++i) {
    const std::size_t at = i * static_cast<std::size_t>(arm.joints);
    out[i] = certifier.run(from + at, to + at);
  }
  __builtin_free(waiting);
}

void arm_sample(const ArmView& arm, const SolidsView* field, const double* from, const double* to, int samples,
                std::size_t begin, std::size_t end, ArmEdge* out) {
  int log2 = 0;
  while ((1 << log2) < samples) {
    ++log2;
  }
  JointLanes joints;
  std::int32_t verdict[W];
  for (std::size_t i = begin; i < end; ++i) {
    const double* a = from + i * static_cast<std::size_t>(arm.joints);
    const double* b = to + i * static_cast<std::size_t>(arm.joints);
    ArmEdge edge{kArmFree, 1.0F, 0};
    for (int k = 0; k < (1 << log2) && edge.verdict == kArmFree;) {
      double t[W];
      int n = 0;
      for (; n < W && k < (1 << log2); ++k) {
        const int at = reversed(k, log2);
        if (at < samples) {
          t[n++] = samples > 1 ? static_cast<double>(at) / (samples - 1) : 0.5;
        }
      }
      if (n == 0) {
        continue;
      }
      for (int lane = 0; lane < W; ++lane) {
        for (int j = 0; j < arm.joints; ++j) {
          put_joint(joints, j, lane, a[j] + t[lane < n ? lane : 0] * (b[j] - a[j]));
        }
      }
      check_lanes(arm, field, joints, n == W ? kAllLanes : (1U << n) - 1U, verdict);
      edge.checked += n;
      for (int lane = 0; lane < n; ++lane) {
        if (verdict[lane] != kArmFree) {
          edge.verdict = verdict[lane];
          edge.at = static_cast<float>(t[lane]);
          break;
        }
      }
    }
    out[i] = edge;
  }
}

void arm_centers(const ArmView& arm, const double* q, std::size_t begin, std::size_t end, float* out) {
  JointLanes joints;
  Pose link[kMostJoints + 1];
  Placed placed;
  for (std::size_t first = begin; first < end; first += W) {
    const int n = load_joints(arm, q, first, end, joints);
    forward(arm, joints, link);
    place_groups(arm, link, placed);
    for (int g = 0; g < arm.groups; ++g) {
      place_spheres(arm, link, g, placed);
    }
    for (int i = 0; i < n; ++i) {
      float* to = out + (first + static_cast<std::size_t>(i)) * 3 * static_cast<std::size_t>(arm.spheres);
      for (int s = 0; s < arm.spheres; ++s) {
        for (int k = 0; k < 3; ++k) {
          to[3 * arm.name[s] + k] = static_cast<float>(arm.base_t[k] + static_cast<double>(placed.at[s][k][i]));
        }
      }
    }
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
