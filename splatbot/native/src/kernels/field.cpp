// SPDX-License-Identifier: Apache-2.0
// Questions to the collision field: hits, the nearest, the k nearest, the Mahalanobis distance.
#include "field_entry.hpp"
#include "solid_tree.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

constexpr float kInfinity = __builtin_inff();

// An ellipsoid: where it is kept, and its name.
struct Found {
  std::int32_t block = -1, leaf = 0, lane = 0, id = -1;
};

struct Seen {
  float bound;
  Found solid;
};

// True if `id` precedes one found already at the same distance: the lowest id wins, that of an unused lane never
// does.
SB_INLINE bool goes_before(std::int32_t id, const Found& found) {
  return found.block >= 0 && static_cast<std::uint32_t>(id) < static_cast<std::uint32_t>(found.id);
}

SB_INLINE void keep_nearer(float distance, const Found& candidate, float& best, Found& found) {
  if (distance < best || (distance == best && goes_before(candidate.id, found))) {
    best = distance;
    found = candidate;
  }
}

// Unused children lie infinitely far off.
template <class Search>
SB_INLINE float limit_of(const Search& search) {
  const float limit = search.limit();
  return limit < 3e38F ? limit : 3e38F;
}

// The leaves `met` of a node: the one with the least bound, then those that are still to be looked at.
template <class Search>
SB_INLINE void visit_leaves(const SolidsView& s, const Split& p, Place place, std::uint32_t met, const float* bounds,
                            Search& search) {
  const SolidNode& node = node_at(s, place);
  SolidLeaf room;
  const auto visit = [&](int i) {
    if (bounds[i] <= limit_of(search)) {
      const std::int32_t leaf = ~node.child[i];
      search.leaf(leaf_of(s.blocks[place.block], leaf, room), p, {place.block, leaf, 0, -1});
    }
  };
  int first = -1;
  for (std::uint32_t m = met; m != 0; m &= m - 1) {
    const int i = __builtin_ctz(m);
    first = first < 0 || bounds[i] < bounds[first] ? i : first;
  }
  if (first < 0) {
    return;
  }
  visit(first);
  for (std::uint32_t m = met & ~(1U << first); m != 0; m &= m - 1) {
    visit(__builtin_ctz(m));
  }
}

// Goal of a walk: `limit` bounds the search, `enter` is called for each node before its children's bounds, `leaf`
// collects the result.
//
// Boxes are visited in order of their bounds. A box is skipped only if its bound is greater than `limit()`, so that
// all equals are seen and the lowest id wins.
template <class Search>
SB_INLINE void walk(const SolidsView& s, const Split& p, Search& search) {
  if (s.top == nullptr) {
    return;
  }
  Place stack[kStack];
  int n = 0;
  stack[n++] = {-1, 0, 0.0F};
  alignas(64) float bounds[kFan];
  while (n > 0) {
    const Place place = stack[--n];
    if (place.bound > limit_of(search)) {
      continue;
    }
    const SolidNode& node = node_at(s, place);
    search.enter(place);
    std::uint32_t met = 0;
    const F limit = set1(limit_of(search));
    for (int at = 0; at < kFan; at += W) {
      const F b = search.bound(node, p, at);
      store(bounds + at, b);
      met |= bits(b <= limit) << at;
    }
    if (place.block >= 0 && node.child[0] < 0) {
      visit_leaves(s, p, place, met, bounds, search);
      continue;
    }
    const int first = n;
    for (; met != 0; met &= met - 1) {
      const int i = __builtin_ctz(met);
      const std::int32_t child = node.child[i];
      Place next{place.block, child, bounds[i]};
      if (place.block < 0) {
        next = child >= 0 ? Place{-1, child, bounds[i]} : Place{~child, 0, bounds[i]};
      }
      int at = n++;
      for (; at > first && stack[at - 1].bound < next.bound; --at) {
        stack[at] = stack[at - 1];
      }
      stack[at] = next;
    }
  }
}

// Bounds are squared distances to boxes.
struct BoxSearch {
  float slack;

  SB_INLINE float limit_at(float distance) const {
    const float reach = distance + slack;
    return reach > 0.0F ? reach * reach * (1.0F + 1e-5F) : 0.0F;
  }
  SB_INLINE void enter(Place) {}
  SB_INLINE F bound(const SolidNode& node, const Split& p, int at) const { return box_squared(node, p, at); }
};

struct NearestSearch : BoxSearch {
  float best;  // certified lower bound of the signed distance so far, or the cut
  Found found = {};

  SB_INLINE float limit() const { return limit_at(best); }

  SB_INLINE void leaf(const LeafView& leaf, const Split& p, Found at_leaf) {
    alignas(64) float d[W];
    for (int at = 0; at < kFan; at += W) {
      const Local l = local_of(leaf, p, at);
      const F margin = set1(best > 0.0F ? best + slack : slack) + rounding(l, least_axis(l));
      const std::uint32_t near = bits(box_squared(l) <= margin * margin * set1(1.0F + 1e-5F));
      if (near == 0) {
        continue;
      }
      store(d, distance_bound<8>(l));
      for (std::uint32_t m = near; m != 0; m &= m - 1) {
        const int i = __builtin_ctz(m);
        keep_nearer(d[i], {at_leaf.block, at_leaf.leaf, at + i, leaf.leaf->id[at + i]}, best, found);
      }
    }
  }
};

struct KSearch : BoxSearch {
  int k;
  float cut;
  int count = 0;
  Seen seen[kMostNearest];

  SB_INLINE float worst() const { return count < k ? cut : seen[count - 1].bound; }
  SB_INLINE float limit() const { return limit_at(worst()); }

  SB_INLINE void leaf(const LeafView& leaf, const Split& p, Found at_leaf) {
    alignas(64) float d[W];
    for (int at = 0; at < kFan; at += W) {
      const Local l = local_of(leaf, p, at);
      store(d, distance_bound<8>(l));
      for (int i = 0; i < W; ++i) {
        const std::int32_t id = leaf.leaf->id[at + i];
        if (id >= 0 && d[i] <= worst()) {
          insert({d[i], {at_leaf.block, at_leaf.leaf, at + i, id}});
        }
      }
    }
  }

  void insert(const Seen& next) {
    if (count == k && !before(next, seen[count - 1])) {
      return;
    }
    int at = count < k ? count++ : count - 1;
    for (; at > 0 && before(next, seen[at - 1]); --at) {
      seen[at] = seen[at - 1];
    }
    seen[at] = next;
  }

  static bool before(const Seen& a, const Seen& b) {
    return a.bound < b.bound || (a.bound == b.bound && a.solid.id < b.solid.id);
  }
};

// Bounds are squared distances in units of the n-sigma ellipsoids.
struct MahalanobisSearch {
  const SolidCoversView& covers;
  float slack;
  float best = kInfinity;  // squared
  const SolidCover* cover = nullptr;
  Found found = {};

  SB_INLINE float limit() const { return best * (1.0F + 1e-5F); }

  SB_INLINE void enter(Place place) {
    cover = (place.block < 0 ? covers.top : covers.blocks[place.block]) + place.node;
  }

  SB_INLINE F bound(const SolidNode& node, const Split& p, int at) const {
    const F size = max(by_box(node, p, at), by_cover(p, at)) * set1(1.0F - 1e-5F);
    return select(size > set1(0.0F), size * size, set1(0.0F));
  }

  // If p is delta beyond a box that contains the ellipsoid's own box, it is at least 1 + delta / extent of that
  // ellipsoid's size away.
  SB_INLINE F by_box(const SolidNode& node, const Split& p, int at) const {
    F most = set1(0.0F);
    for (int k = 0; k < 3; ++k) {
      const F beyond = gap(node.low[k], node.high[k], at, set1(p.hi[k])) - set1(slack);
      most = max(most, beyond / load(node.reach[k] + at));
    }
    return select(most > set1(0.0F), most + set1(1.0F), set1(0.0F));
  }

  // The rounding error of float32 is below 4e-6 of |d|_1 over the least semi-axis, here and in a leaf together.
  SB_INLINE F by_cover(const Split& p, int at) const {
    const F x = set1(p.hi[0]) - load(cover->center[0] + at), y = set1(p.hi[1]) - load(cover->center[1] + at),
            z = set1(p.hi[2]) - load(cover->center[2] + at);
    const F u = load(cover->whiten[0] + at) * x;
    const F v = fma(load(cover->whiten[1] + at), x, load(cover->whiten[2] + at) * y);
    const F w = fma(load(cover->whiten[3] + at), x, fma(load(cover->whiten[4] + at), y, load(cover->whiten[5] + at) * z));
    const F far = absolute(x) + absolute(y) + absolute(z);
    const F rounded = load(cover->thin + at) * fma(set1(kCoverRounding), far, set1(slack));
    return sqrt(fma(u, u, fma(v, v, w * w))) - load(cover->radius + at) - rounded;
  }

  SB_INLINE void leaf(const LeafView& leaf, const Split& p, Found at_leaf) {
    alignas(64) float d[W];
    for (int at = 0; at < kFan; at += W) {
      const Local l = local_of(leaf, p, at);
      const F x = l.v[0] / l.a[0], y = l.v[1] / l.a[1], z = l.v[2] / l.a[2];
      const F squared = fma(x, x, fma(y, y, z * z));
      std::uint32_t near = bits(squared <= set1(best));
      if (near == 0) {
        continue;
      }
      store(d, squared);
      for (; near != 0; near &= near - 1) {
        const int i = __builtin_ctz(near);
        keep_nearer(d[i], {at_leaf.block, at_leaf.leaf, at + i, leaf.leaf->id[at + i]}, best, found);
      }
    }
  }
};

// One ellipsoid in float64.
struct Exact {
  double v[3], a[3], R[9], mean[3];
  double off;  // of packing
};

Exact exact_of(const SolidsView& s, const Found& found, const double* p) {
  SolidLeaf room;
  const LeafView view = leaf_of(s.blocks[found.block], found.leaf, room);
  const SolidLeaf& leaf = *view.leaf;
  const int lane = found.lane;
  Exact e;
  double q[4], norm = 0.0;
  for (int k = 0; k < 4; ++k) {
    q[k] = static_cast<double>(leaf.quat[k][lane]);
    norm += q[k] * q[k];
  }
  const double w = q[0], x = q[1], y = q[2], z = q[3], t = 2.0 / norm;
  const double R[9] = {1 - t * (y * y + z * z), t * (x * y - w * z),     t * (x * z + w * y),
                       t * (x * y + w * z),     1 - t * (x * x + z * z), t * (y * z - w * x),
                       t * (x * z - w * y),     t * (y * z + w * x),     1 - t * (x * x + y * y)};
  double d[3];
  for (int k = 0; k < 3; ++k) {
    e.mean[k] = static_cast<double>(leaf.mean[k][lane]);
    e.a[k] = static_cast<double>(leaf.axes[k][lane]);
    d[k] = p[k] - e.mean[k];
  }
  const double longest = e.a[0] > e.a[1] ? e.a[0] : e.a[1];
  e.off = static_cast<double>(view.off) + static_cast<double>(view.turn) * (e.a[2] > longest ? e.a[2] : longest);
  for (int i = 0; i < 9; ++i) {
    e.R[i] = R[i];
  }
  for (int k = 0; k < 3; ++k) {
    e.v[k] = R[k] * d[0] + R[3 + k] * d[1] + R[6 + k] * d[2];
  }
  return e;
}

// The signed distance in float64, its normal and the nearest point: distance_bound() to the end.
void solve(const Exact& e, NearestSolid& out) {
  double least = e.a[0], D[3], v[3], b[3], s = 0.0;
  for (int k = 1; k < 3; ++k) {
    least = e.a[k] < least ? e.a[k] : least;
  }
  for (int k = 0; k < 3; ++k) {
    const double size = e.v[k] < 0.0 ? -e.v[k] : e.v[k];
    v[k] = e.a[k] <= least && size < 1e-7 * least ? 1e-7 * least : size;
    D[k] = (e.a[k] - least) * (e.a[k] + least);
    b[k] = e.a[k] * v[k];
    s = b[k] - D[k] > s ? b[k] - D[k] : s;
  }
  for (int i = 0; i < 60; ++i) {
    double norm2 = 0.0, slope = 0.0;
    for (int k = 0; k < 3; ++k) {
      const double inverse = 1.0 / (D[k] + s), q = b[k] * inverse;
      norm2 += q * q;
      slope += q * q * inverse;
    }
    const double step = (__builtin_sqrt(norm2) - 1.0) * norm2 / slope;
    if (!(step > 1e-15 * s)) {
      break;
    }
    s += step;
  }
  double n[3], length = 0.0, along = 0.0, support = 0.0;
  for (int k = 0; k < 3; ++k) {
    n[k] = v[k] * (s / (D[k] + s));
    length += n[k] * n[k];
  }
  length = __builtin_sqrt(length);
  double at[3];
  for (int k = 0; k < 3; ++k) {
    n[k] /= length;
    along += n[k] * (e.v[k] < 0.0 ? -e.v[k] : e.v[k]);
    support += e.a[k] * n[k] * (e.a[k] * n[k]);
  }
  support = __builtin_sqrt(support);
  for (int k = 0; k < 3; ++k) {
    const double sign = e.v[k] < 0.0 ? -1.0 : 1.0;
    n[k] *= sign;
    at[k] = e.a[k] * e.a[k] * n[k] / support;
  }
  out.distance = along - support;
  for (int k = 0; k < 3; ++k) {
    out.normal[k] = e.R[3 * k] * n[0] + e.R[3 * k + 1] * n[1] + e.R[3 * k + 2] * n[2];
    out.point[k] = e.mean[k] + e.R[3 * k] * at[0] + e.R[3 * k + 1] * at[1] + e.R[3 * k + 2] * at[2];
  }
}

// Certified and smooth: the float64 distance of the winner, less the largest error of float32 and packing. If the
// bound did not come that close, the bound itself.
double certified(const Exact& e, double exact, double bound) {
  double size = e.a[0];
  for (int k = 0; k < 3; ++k) {
    size = e.a[k] < size ? e.a[k] : size;
  }
  for (int k = 0; k < 3; ++k) {
    size += e.v[k] < 0.0 ? -e.v[k] : e.v[k];
  }
  const double lower = exact - 3.0 * static_cast<double>(kRounding) * size - e.off;
  return lower <= bound ? lower : bound;
}

SB_INLINE float radius_of(const SphereQueries& q, std::size_t i) { return q.radii == nullptr ? 0.0F : q.radii[i]; }

}  // namespace

void field_hits(const SolidsView& s, const SphereQueries& q, std::size_t begin, std::size_t end, std::uint8_t* out) {
  for (std::size_t i = begin; i < end; ++i) {
    out[i] = sphere_hit(s, split(q.centers + 3 * i), radius_of(q, i)) ? 1 : 0;
  }
}

void field_nearest(const SolidsView& s, const SphereQueries& q, float cut, std::size_t begin, std::size_t end,
                   NearestSolid* out) {
  for (std::size_t i = begin; i < end; ++i) {
    const double* center = q.centers + 3 * i;
    const Split p = split(center);
    const float r = radius_of(q, i);
    NearestSearch search{{p.slack}, cut + r};
    NearestSolid& answer = out[i];
    answer = {static_cast<double>(kInfinity), {0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}, -1};
    if (grid_bound(s.grid, p) > cut + r) {
      continue;
    }
    walk(s, p, search);
    if (search.found.block >= 0) {
      const Exact e = exact_of(s, search.found, center);
      solve(e, answer);
      answer.distance = certified(e, answer.distance, static_cast<double>(search.best)) - static_cast<double>(r);
      answer.id = search.found.id;
    }
  }
}

void field_k_nearest(const SolidsView& s, const SphereQueries& q, int k, float cut, std::size_t begin, std::size_t end,
                     double* distance, std::int32_t* id) {
  for (std::size_t i = begin; i < end; ++i) {
    const double* center = q.centers + 3 * i;
    const Split p = split(center);
    const float r = radius_of(q, i);
    KSearch search{{p.slack}, k, cut + r, 0, {}};
    walk(s, p, search);
    const auto row = i * static_cast<std::size_t>(k);
    for (int j = 0; j < k; ++j) {
      const auto at = row + static_cast<std::size_t>(j);
      distance[at] = static_cast<double>(kInfinity);
      id[at] = -1;
      if (j < search.count) {
        const Seen& seen = search.seen[j];
        const Exact e = exact_of(s, seen.solid, center);
        NearestSolid solved;
        solve(e, solved);
        distance[at] = certified(e, solved.distance, static_cast<double>(seen.bound)) - static_cast<double>(r);
        id[at] = seen.solid.id;
      }
    }
  }
}

void field_mahalanobis(const SolidsView& s, const SolidCoversView& covers, const double* points,
                       const std::uint32_t* order, std::size_t begin, std::size_t end, double* distance,
                       std::int32_t* id) {
  Found last;  // the nearest Gaussian of the previous point bounds the search closely
  for (std::size_t at = begin; at < end; ++at) {
    const std::size_t i = order[at];
    const Split p = split(points + 3 * i);
    MahalanobisSearch search{.covers = covers, .slack = 2.0F * p.slack};
    if (last.block >= 0) {
      SolidLeaf room;
      search.leaf(leaf_of(s.blocks[last.block], last.leaf, room), p, last);
    }
    walk(s, p, search);
    last = search.found;
    distance[i] = static_cast<double>(kInfinity);
    id[i] = -1;
    if (search.found.block >= 0) {
      const Exact e = exact_of(s, search.found, points + 3 * i);
      double squared = 0.0;
      for (int k = 0; k < 3; ++k) {
        squared += (e.v[k] / e.a[k]) * (e.v[k] / e.a[k]);
      }
      distance[i] = static_cast<double>(s.n_sigma) * __builtin_sqrt(squared);
      id[i] = search.found.id;
    }
  }
}

void field_grid_bounds(const SolidsView& s, const double* points, std::size_t begin, std::size_t end, float* out) {
  for (std::size_t i = begin; i < end; ++i) {
    const float bound = grid_bound(s.grid, split(points + 3 * i));
    out[i] = bound < 0.0F ? 0.0F : bound;
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
