// SPDX-License-Identifier: Apache-2.0
// The collision field and an arm in it, under the sanitizers: packed and not, and through updates. Many threads query it
// during the construction of the next field. Distances are compared with bisection in float64. The number of
// threads changes no bit.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <limits>
#include <memory>
#include <random>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "promises.hpp"
#include "splatbot/arm.hpp"
#include "splatbot/field.hpp"
#include "splatbot/threads.hpp"

namespace {

using namespace splatbot;

struct Map {
  std::vector<float> means, quats, scales;
  std::vector<std::int32_t> ids;

  // Discs, needles and balls in a box of 2 m, some huge, some far off, some on one place.
  Map(std::size_t count, unsigned seed, std::int32_t first_id = 0) {
    std::mt19937 random(seed);
    std::normal_distribution<float> normal;
    std::uniform_real_distribution<float> uniform(-1.0F, 1.0F);
    for (std::size_t i = 0; i < count; ++i) {
      const float far_off = i % 97 == 0 ? 900.0F : 1.0F;
      for (int k = 0; k < 3; ++k) {
        means.push_back(i % 31 == 0 ? 0.25F : far_off * uniform(random));
        scales.push_back(i % 101 == 0 ? 0.4F : std::pow(10.0F, -3.2F + uniform(random)));
      }
      for (int k = 0; k < 4; ++k) {
        quats.push_back(i % 13 == 0 ? 0.5F : normal(random));
      }
      ids.push_back(first_id + static_cast<std::int32_t>(i));
    }
  }

  Solids solids() const { return {means, quats, scales, ids}; }

  void append(const Map& other) {
    means.insert(means.end(), other.means.begin(), other.means.end());
    quats.insert(quats.end(), other.quats.begin(), other.quats.end());
    scales.insert(scales.end(), other.scales.begin(), other.scales.end());
    ids.insert(ids.end(), other.ids.begin(), other.ids.end());
  }
};

constexpr float kSigma = 2.0F;

// A point in the frame of Gaussian i: along its axes, from its mean.
std::array<double, 3> seen_from(const Map& map, std::size_t i, const double* p) {
  double q[4], norm = 0.0;
  for (std::size_t k = 0; k < 4; ++k) {
    q[k] = static_cast<double>(map.quats[4 * i + k]);
    norm += q[k] * q[k];
  }
  const double w = q[0], x = q[1], y = q[2], z = q[3], t = 2.0 / norm;
  const double R[9] = {1 - t * (y * y + z * z), t * (x * y - w * z),     t * (x * z + w * y),
                       t * (x * y + w * z),     1 - t * (x * x + z * z), t * (y * z - w * x),
                       t * (x * z - w * y),     t * (y * z + w * x),     1 - t * (x * x + y * y)};
  std::array<double, 3> v{};
  for (std::size_t k = 0; k < 3; ++k) {
    for (std::size_t j = 0; j < 3; ++j) {
      v[k] += R[3 * j + k] * (p[j] - static_cast<double>(map.means[3 * i + j]));
    }
  }
  return v;
}

// The signed distance of a point to the n-sigma ellipsoid of Gaussian i, by bisection for the root s. The equation is
// sum (a v / (a^2 - min a^2 + s))^2 = 1 (Eberly, distance from a point to an ellipsoid).
double distance_to(const Map& map, std::size_t i, const double* p) {
  std::array<double, 3> v = seen_from(map, i, p);
  double a[3], least = 1e30;
  for (std::size_t k = 0; k < 3; ++k) {
    a[k] = static_cast<double>(kSigma) * static_cast<double>(map.scales[3 * i + k]);
    least = std::min(least, a[k]);
    v[k] = std::abs(v[k]);
  }
  double low = 0.0, high = 0.0, D[3];
  for (std::size_t k = 0; k < 3; ++k) {
    D[k] = a[k] * a[k] - least * least;
    v[k] = a[k] <= least ? std::max(v[k], 1e-12 * least) : v[k];
    low = std::max(low, a[k] * v[k] - D[k]);
    high += a[k] * v[k];
  }
  high = std::max(high, low);
  const auto sum = [&](double s, bool with_axes) {
    double total = 0.0;
    for (std::size_t k = 0; k < 3; ++k) {
      const double part = (with_axes ? a[k] : 1.0) * v[k] / (D[k] + s);
      total += part * part;
    }
    return total;
  };
  for (int step = 0; step < 100; ++step) {
    const double middle = 0.5 * (low + high);
    (sum(middle, true) > 1.0 ? low : high) = middle;
  }
  return (high - least * least) * std::sqrt(sum(high, false));
}

double mahalanobis_to(const Map& map, std::size_t i, const double* p) {
  const std::array<double, 3> v = seen_from(map, i, p);
  double sum = 0.0;
  for (std::size_t k = 0; k < 3; ++k) {
    const double part = v[k] / static_cast<double>(map.scales[3 * i + k]);
    sum += part * part;
  }
  return std::sqrt(sum);
}

std::vector<double> points_in_box(std::size_t count, unsigned seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> uniform(-1.2, 1.2);
  std::vector<double> points;
  for (std::size_t i = 0; i < 3 * count; ++i) {
    points.push_back(uniform(random));
  }
  return points;
}

// All answers of a field for some points, as numbers to compare.
std::vector<double> answers(const CollisionField& field, const std::vector<double>& points) {
  const std::size_t n = points.size() / 3;
  std::vector<float> radii(n, 0.03F), bounds(n);
  std::vector<std::uint8_t> hits(n);
  std::vector<NearestSolid> nearest(n);
  std::vector<double> distance(4 * n), mahalanobis(n), all;
  std::vector<std::int32_t> ids(4 * n), id(n);
  field.hits({points.data(), radii.data()}, n, hits);
  field.nearest({points.data(), nullptr}, n, std::numeric_limits<float>::infinity(), nearest);
  field.k_nearest({points.data(), nullptr}, n, 4, 0.5F, distance, ids);
  field.mahalanobis(points, mahalanobis, id);
  field.grid_bounds(points, bounds);
  for (std::size_t i = 0; i < n; ++i) {
    promise(static_cast<double>(bounds[i]) <= std::max(0.0, nearest[i].distance) + 0.01, "the grid's bound holds");
    promise((hits[i] != 0) || nearest[i].distance > 0.03 - 1e-2, "hits and distances agree");
    all.insert(all.end(), {static_cast<double>(hits[i]), nearest[i].distance, nearest[i].normal[0],
                           static_cast<double>(nearest[i].id), mahalanobis[i], static_cast<double>(id[i])});
  }
  all.insert(all.end(), distance.begin(), distance.end());
  all.insert(all.end(), ids.begin(), ids.end());
  return all;
}

void check_distances(const Map& map, const CollisionField& field, bool packed) {
  const std::vector<double> points = points_in_box(60, 5);
  std::vector<NearestSolid> found(points.size() / 3);
  field.nearest({points.data(), nullptr}, found.size(), std::numeric_limits<float>::infinity(), found);
  for (std::size_t i = 0; i < found.size(); ++i) {
    double truth = 1e30;
    for (std::size_t s = 0; s < map.ids.size(); ++s) {
      truth = std::min(truth, distance_to(map, s, &points[3 * i]));
    }
    promise(found[i].distance <= truth, "no distance exceeds the true one");
    promise(found[i].distance >= truth - (packed ? 4e-3 : 2e-5), "no distance is far below the true one");
  }
}

// The smallest Mahalanobis distance by looking at every Gaussian in float64.
void check_mahalanobis(const Map& map, const CollisionField& field) {
  const std::vector<double> points = points_in_box(300, 15);
  std::vector<double> found(points.size() / 3);
  std::vector<std::int32_t> id(found.size());
  field.mahalanobis(points, found, id);
  for (std::size_t i = 0; i < found.size(); ++i) {
    double least = 1e30, own = 1e30;
    for (std::size_t s = 0; s < map.ids.size(); ++s) {
      const double here = mahalanobis_to(map, s, &points[3 * i]);
      least = std::min(least, here);
      own = map.ids[s] == id[i] ? here : own;
    }
    promise(std::abs(found[i] - own) <= 1e-4 * own + 1e-4, "a Mahalanobis distance is that of the Gaussian named");
    promise(own <= least * (1.0 + 1e-3) + 1e-3, "no Gaussian is nearer than the one named");
  }
}

// An updated field, and the same built from scratch, while another thread queries the earlier one.
void check_updates(const Map& map, const FieldOptions& options) {
  const auto field = std::make_shared<const CollisionField>(map.solids(), options);
  const std::vector<double> points = points_in_box(200, 6);
  const std::vector<double> before = answers(*field, points);
  const auto count = static_cast<std::int32_t>(map.ids.size());
  const Map more(150, 9, count);
  std::vector<std::int32_t> removed;
  Map rest(0, 0);
  for (std::size_t i = 0; i < map.ids.size(); ++i) {
    if (i % 7 == 0) {
      removed.push_back(map.ids[i]);
      continue;
    }
    Map one(0, 0);
    one.means.assign(map.means.begin() + static_cast<std::ptrdiff_t>(3 * i), map.means.begin() + static_cast<std::ptrdiff_t>(3 * i + 3));
    one.scales.assign(map.scales.begin() + static_cast<std::ptrdiff_t>(3 * i), map.scales.begin() + static_cast<std::ptrdiff_t>(3 * i + 3));
    one.quats.assign(map.quats.begin() + static_cast<std::ptrdiff_t>(4 * i), map.quats.begin() + static_cast<std::ptrdiff_t>(4 * i + 4));
    one.ids.push_back(map.ids[i]);
    rest.append(one);
  }
  rest.append(more);
  std::shared_ptr<const CollisionField> next;
  std::thread writer([&] { next = field->updated(removed, more.solids()); });
  const std::vector<double> meanwhile = answers(*field, points);
  writer.join();
  promise(meanwhile == before, "a field answers as before while the next one is made");
  promise(answers(*next, points) == answers(CollisionField(rest.solids(), options), points),
          "an updated field answers as one made anew");
  promise(next->added_since(*field)->size() <= more.ids.size(), "what is new is no more than what was added");
  promise(next->shared_bytes(*field) <= next->bytes(), "shared bytes are a part");
  const auto emptied = field->updated(map.ids, Solids{});
  promise(emptied->size() == 0 && answers(*emptied, points).size() == before.size(), "an emptied field answers");
}

// Seven joints about z and sideways by turns, spheres along them.
struct Chain {
  std::vector<double> joints, travel, centers, radii, base;
  std::vector<std::uint8_t> prismatic;
  std::vector<std::int32_t> link, pairs;

  Chain() {
    for (int j = 0; j < 7; ++j) {
      const double sign = j % 2 == 0 ? 1.0 : -1.0;
      joints.insert(joints.end(), {1, 0, 0, 0.02, 0, 0, -sign, 0.15 * (j % 2), 0, sign, 0, 0.1 * sign});
      prismatic.push_back(j == 3 ? 1 : 0);
      travel.push_back(j == 3 ? 0.2 : 2.9);
      for (int s = 0; s < 4; ++s) {
        link.push_back(j + 1);
        centers.insert(centers.end(), {0.0, 0.01 * s, 0.04 * s});
        radii.push_back(0.03);
      }
    }
    pairs = {1, 4, 1, 5, 2, 6, 3, 7};
    base = {1, 0, 0, -0.3, 0, 1, 0, 0.2, 0, 0, 1, 0};
  }

  ArmSpec spec() const { return {joints, prismatic, travel, link, centers, radii, pairs, base, false}; }
};

std::vector<double> answers(const Arm& arm, const CollisionField* field, const std::vector<double>& q) {
  const std::size_t n = q.size() / 7;
  std::vector<double> to(q.rbegin(), q.rend()), all, poses(n * 8 * 16), centers(3 * n * 28);
  std::vector<float> centers_float(3 * n * 28);
  std::vector<std::int32_t> verdict(n);
  std::vector<ArmEdge> certified(n), sampled(n);
  std::vector<ArmClearance> room(n);
  arm.forward(q, poses);
  arm.centers(q, centers);
  arm.centers_float(q, centers_float);
  arm.configurations(field, q, verdict);
  arm.certify(field, q, to, 1e-3F, certified);
  arm.sample(field, q, to, 33, sampled);
  if (field != nullptr) {
    arm.clearance(*field, q, 0.5, room);
  }
  for (std::size_t i = 0; i < centers.size(); ++i) {
    promise(std::abs(centers[i] - static_cast<double>(centers_float[i])) <= kArmRounding, "float32 is within a micrometre");
  }
  for (std::size_t i = 0; i < n; ++i) {
    promise(certified[i].verdict != kArmFree || sampled[i].verdict == kArmFree, "no sample hits on a certified edge");
    promise(field == nullptr || verdict[i] != kArmFree || room[i].distance > -1e-4, "free configurations have room");
    all.insert(all.end(), {static_cast<double>(verdict[i]), static_cast<double>(certified[i].verdict),
                           static_cast<double>(certified[i].at), static_cast<double>(sampled[i].verdict),
                           field != nullptr ? room[i].distance : 0.0});
  }
  return all;
}

void check_arm(const CollisionField& field) {
  const Chain chain;
  const Arm arm(chain.spec());
  std::mt19937 random(8);
  std::uniform_real_distribution<double> uniform(-1.0, 1.0);
  std::vector<double> q;
  for (int i = 0; i < 70; ++i) {
    for (int j = 0; j < 7; ++j) {
      q.push_back(j == 3 ? 0.1 * uniform(random) : 2.5 * uniform(random));
    }
  }
  for (const CollisionField* against : {&field, static_cast<const CollisionField*>(nullptr)}) {
    set_num_threads(1);
    const std::vector<double> want = answers(arm, against, q);
    for (const unsigned threads : {2U, 8U}) {
      set_num_threads(threads);
      promise(answers(arm, against, q) == want, "threads change no bit of an arm's answers");
    }
  }
  Chain wrong;
  wrong.pairs = {1, 9};
  bool thrown = false;
  try {
    const Arm refused(wrong.spec());
  } catch (const std::invalid_argument&) {
    thrown = true;
  }
  promise(thrown, "a pair of a link that is not there is refused");
}

}  // namespace

void check_collision(const std::string& isa) {
  const Map map(700, 4);
  const std::vector<double> points = points_in_box(300, 7);
  for (const bool packed : {false, true}) {
    const FieldOptions options{.n_sigma = kSigma, .voxel = 0.05F, .max_voxels = 60'000, .packed = packed};
    set_num_threads(1);
    const CollisionField field(map.solids(), options);
    const std::vector<double> want = answers(field, points);
    for (const unsigned threads : {2U, 8U}) {
      set_num_threads(threads);
      promise(answers(CollisionField(map.solids(), options), points) == want, "threads change no bit of a field's answers");
    }
    check_distances(map, field, packed);
    if (!packed) {
      check_mahalanobis(map, field);
    }
    check_updates(map, options);
    check_arm(field);
  }
  std::printf("%s: collision fields, packed and not, updated, and an arm in them, on 1, 2 and 8 threads\n", isa.c_str());
}
