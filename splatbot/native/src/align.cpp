// SPDX-License-Identifier: Apache-2.0
#include "splatbot/align.hpp"

#include <algorithm>
#include <cmath>

namespace splatbot {
namespace {

using Mat4 = std::array<double, 16>;
using Vec6 = std::array<double, 6>;
using Mat6 = std::array<double, 36>;

constexpr double kStepDone = 1e-5;  // [m] and [rad]
constexpr double kDamping = 1e-5;   // share of the mean diagonal

Mat4 multiply(std::span<const double, 16> A, std::span<const double, 16> B) {
  Mat4 C{};
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j)
      for (int k = 0; k < 4; ++k) C[4 * i + j] += A[4 * i + k] * B[4 * k + j];
  return C;
}

// Exponential of a twist (t, ω); the series stand in where θ is small.
Mat4 se3_exp(const Vec6& xi) {
  const double wx = xi[3], wy = xi[4], wz = xi[5];
  const double theta2 = wx * wx + wy * wy + wz * wz, theta = std::sqrt(theta2);
  const bool small = theta < 1e-4;
  const double half = 0.5 * theta;
  const double a = small ? 1.0 - theta2 / 6.0 : std::sin(theta) / theta;
  const double b = small ? 0.5 - theta2 / 24.0 : 0.5 * std::pow(std::sin(half) / half, 2);
  const double c = small ? 1.0 / 6.0 - theta2 / 120.0 : (1.0 - a) / theta2;
  const double K[9] = {0, -wz, wy, wz, 0, -wx, -wy, wx, 0};
  double K2[9] = {};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      for (int k = 0; k < 3; ++k) K2[3 * i + j] += K[3 * i + k] * K[3 * k + j];
  Mat4 T{};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      const double unit = i == j ? 1.0 : 0.0;
      T[4 * i + j] = unit + a * K[3 * i + j] + b * K2[3 * i + j];
      T[4 * i + 3] += (unit + b * K[3 * i + j] + c * K2[3 * i + j]) * xi[j];
    }
  }
  T[15] = 1.0;
  return T;
}

Mat4 inverse(std::span<const double, 16> T) {
  Mat4 R{};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      R[4 * i + j] = T[4 * j + i];
      R[4 * i + 3] -= T[4 * j + i] * T[4 * j + 3];
    }
  }
  R[15] = 1.0;
  return R;
}

// Twist (t, ω) of a pose that turns by less than π; the translation to first order in ω.
Vec6 se3_log_near(std::span<const double, 16> T) {
  const double v[3] = {0.5 * (T[9] - T[6]), 0.5 * (T[2] - T[8]), 0.5 * (T[4] - T[1])};  // sin θ times the axis
  const double sine = std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), cosine = 0.5 * (T[0] + T[5] + T[10] - 1.0);
  const double scale = sine < 1e-6 ? 1.0 : std::atan2(sine, cosine) / sine;
  const double w[3] = {scale * v[0], scale * v[1], scale * v[2]}, t[3] = {T[3], T[7], T[11]};
  return {t[0] - 0.5 * (w[1] * t[2] - w[2] * t[1]), t[1] - 0.5 * (w[2] * t[0] - w[0] * t[2]),
          t[2] - 0.5 * (w[0] * t[1] - w[1] * t[0]), w[0], w[1], w[2]};
}

// Σ ψ' / Σ ψ(r)/r over Student-t residuals r/σ: how much of their weights is curvature (Huber 1967).
struct Curving {
  double curvature = 0.0, weight = 0.0;

  void add(double r, double nu) {
    const double sum = nu + r * r;
    curvature += (nu + 1.0) * (nu - r * r) / (sum * sum);
    weight += (nu + 1.0) / sum;
  }

  void add(std::span<const float> residuals, double nu) {
    for (const float r : residuals)
      if (!std::isnan(r)) add(r, nu);
  }

  // Half of all residuals beyond σ √ν would leave no minimum; a tenth keeps the covariance finite.
  double share() const { return weight > 0.0 ? std::max(curvature / weight, 0.1) : 1.0; }
};

// Gradients by cell of the current image.
class Cells {
 public:
  static constexpr int kCount = kAlignCellColumns * kAlignCellRows;

  // Cell of a place in an image of that size, -1 outside.
  static int of(double u, double v, double width, double height) {
    if (!(u >= 0 && v >= 0 && u < width && v < height)) return -1;
    return static_cast<int>(v * kAlignCellRows / height) * kAlignCellColumns +
           static_cast<int>(u * kAlignCellColumns / width);
  }

  void add(int cell, const Vec6& g, const Mat6& H) {
    for (int i = 0; i < 6; ++i) sums_[cell][i] += g[i];
    for (int i = 0; i < 36; ++i) H_[cell][i] += H[i];
    used_[cell] = true;
  }

  // How much larger the spread of the gradients is than the noise model says, which is 1 for independent residuals of
  // the noise that it states. About the minimum of these residuals, wherever the pose is; 0 where there are too few.
  double excess() const;

  void report(AlignResult& result) const {
    for (int c = 0; c < kCount; ++c) {
      if (!used_[c]) continue;
      ++result.cells;
      for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) result.spread[6 * i + j] += sums_[c][i] * sums_[c][j];
    }
  }

 private:
  std::array<Vec6, kCount> sums_{};
  std::array<Mat6, kCount> H_{};
  std::array<bool, kCount> used_{};
};

struct Normal {
  Mat6 H{};
  Vec6 g{};

  // Damped Gauss-Newton step by LDLᵀ; zero where there is no information.
  Vec6 solve() const {
    double trace = 0.0;
    for (int i = 0; i < 6; ++i) trace += H[7 * i];
    Vec6 x{};
    if (!(trace > 0.0)) return x;
    Mat6 L = H;
    for (int i = 0; i < 6; ++i) L[7 * i] += kDamping * trace / 6.0;
    for (int j = 0; j < 6; ++j) {
      for (int k = 0; k < j; ++k) L[7 * j] -= L[6 * j + k] * L[6 * j + k] * L[7 * k];
      for (int i = j + 1; i < 6; ++i) {
        for (int k = 0; k < j; ++k) L[6 * i + j] -= L[6 * i + k] * L[6 * j + k] * L[7 * k];
        L[6 * i + j] /= L[7 * j];
      }
    }
    for (int i = 0; i < 6; ++i) {
      x[i] = -g[i];
      for (int k = 0; k < i; ++k) x[i] -= L[6 * i + k] * x[k];
    }
    for (int i = 0; i < 6; ++i) x[i] /= L[7 * i];
    for (int i = 5; i >= 0; --i)
      for (int k = i + 1; k < 6; ++k) x[i] -= L[6 * k + i] * x[k];
    return x;
  }
};

double Cells::excess() const {
  Normal total;
  int n = 0;
  for (int c = 0; c < kCount; ++c) {
    n += used_[c] ? 1 : 0;
    for (int i = 0; i < 6; ++i) total.g[i] += sums_[c][i];
    for (int i = 0; i < 36; ++i) total.H[i] += H_[c][i];
  }
  if (n < 2 * 6) return 0.0;
  const Vec6 x = total.solve();
  double excess = 0.0;
  for (int i = 0; i < 6; ++i) {
    double squares = 0.0;
    for (int c = 0; c < kCount; ++c) {
      double g = sums_[c][i];
      for (int j = 0; j < 6; ++j) g += H_[c][6 * i + j] * x[j];
      squares += g * g;
    }
    if (total.H[7 * i] > 0.0) excess += squares / total.H[7 * i] / 6.0;
  }
  return excess * n / (n - 6);
}

// What one residual of each kind weighs.
struct Weights {
  double dense, matches;
};

// One reference on one level, with that pair's own exposure (a, b).
class DenseTerm {
 public:
  DenseTerm(const AlignImage& image, const AlignPoints& points, std::span<const double, 16> T_world_reference)
      : image_(image), points_(points), T_world_reference_(T_world_reference) {}

  // Add this term, exposure marginalised (Schur complement); remember how exposure would follow a step.
  void add(std::span<const double, 16> T_camera_world, const AlignPlan& plan, double weight, Normal& total) {
    const Mat4 T = multiply(T_camera_world, T_world_reference_);
    const AlignSums s = linearize_alignment(image_, points_, T, a_, b_, plan.settings, {}, {});
    inverse_ = exposure_inverse(s);
    residual_ = {s.g[6] + kExposurePrior * (a_ - 1.0), s.g[7] + kExposurePrior * b_};
    for (int i = 0; i < 6; ++i) {
      coupling_[2 * i] = s.H[8 * i + 6];
      coupling_[2 * i + 1] = s.H[8 * i + 7];
    }
    for (int i = 0; i < 6; ++i) {
      const double c0 = coupling_[2 * i], c1 = coupling_[2 * i + 1];
      const double k0 = c0 * inverse_[0] + c1 * inverse_[1], k1 = c0 * inverse_[1] + c1 * inverse_[2];
      for (int j = 0; j < 6; ++j)
        H_[6 * i + j] = weight * (s.H[8 * i + j] - k0 * coupling_[2 * j] - k1 * coupling_[2 * j + 1]);
      total.g[i] += weight * (s.g[i] - k0 * residual_[0] - k1 * residual_[1]);
    }
    for (int i = 0; i < 36; ++i) total.H[i] += H_[i];
  }

  // Gradients of this term by cell, and its curvature, exposure marginalised as in `add`, which came before.
  void scatter(std::span<const double, 16> T_camera_world, const AlignPlan& plan, double weight, Cells& cells,
               Mat6& curvature) const {
    Mat6 H_geometric{};
    Curving of_photometric, of_geometric;
    const Mat4 T = multiply(T_camera_world, T_world_reference_);
    const std::vector<std::vector<std::size_t>> members = by_cell(T);
    std::vector<float> points, normals, gray, r_photometric, r_geometric;
    for (int c = 0; c < Cells::kCount; ++c) {
      points.clear();
      normals.clear();
      gray.clear();
      for (const std::size_t i : members[c]) {
        points.insert(points.end(), &points_.points[3 * i], &points_.points[3 * i] + 3);
        normals.insert(normals.end(), &points_.normals[3 * i], &points_.normals[3 * i] + 3);
        gray.push_back(points_.gray[i]);
      }
      if (gray.empty()) continue;
      r_photometric.resize(gray.size());
      r_geometric.resize(gray.size());
      const AlignSums s = linearize_alignment(image_, {points, normals, gray}, T, a_, b_, plan.settings, r_photometric,
                                              r_geometric);
      if (s.photometric + s.geometric == 0) continue;
      of_photometric.add(r_photometric, plan.settings.nu);
      of_geometric.add(r_geometric, plan.settings.nu);
      Vec6 g{};
      Mat6 H{};
      for (int i = 0; i < 6; ++i) {
        const double k0 = coupling_[2 * i] * inverse_[0] + coupling_[2 * i + 1] * inverse_[1];
        const double k1 = coupling_[2 * i] * inverse_[1] + coupling_[2 * i + 1] * inverse_[2];
        g[i] = weight * (s.g[i] - k0 * s.g[6] - k1 * s.g[7]);
        for (int j = 0; j < 6; ++j)
          H[6 * i + j] = weight * (s.H[8 * i + j] - k0 * s.H[8 * j + 6] - k1 * s.H[8 * j + 7]);
      }
      cells.add(c, g, H);
    }
    AlignSettings geometric = plan.settings;
    geometric.use_photometric = false;
    const AlignSums s = linearize_alignment(image_, points_, T, a_, b_, geometric, {}, {});
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j < 6; ++j) H_geometric[6 * i + j] = weight * s.H[8 * i + j];
    for (int i = 0; i < 36; ++i)
      curvature[i] += of_photometric.share() * (H_[i] - H_geometric[i]) + of_geometric.share() * H_geometric[i];
  }

  // Back-substitute the exposure that belongs to a twist step.
  void follow(const Vec6& step) {
    double r0 = residual_[0], r1 = residual_[1];
    for (int i = 0; i < 6; ++i) {
      r0 += coupling_[2 * i] * step[i];
      r1 += coupling_[2 * i + 1] * step[i];
    }
    a_ -= inverse_[0] * r0 + inverse_[1] * r1;
    b_ -= inverse_[1] * r0 + inverse_[2] * r1;
  }

 private:
  // Indices of the points that land in each cell.
  std::vector<std::vector<std::size_t>> by_cell(const Mat4& T) const {
    std::vector<std::vector<std::size_t>> members(Cells::kCount);
    for (std::size_t i = 0; i < points_.gray.size(); ++i) {
      const float* p = &points_.points[3 * i];
      const double z = T[8] * p[0] + T[9] * p[1] + T[10] * p[2] + T[11];
      if (!(z > 1e-3)) continue;
      const double u = image_.fx * (T[0] * p[0] + T[1] * p[1] + T[2] * p[2] + T[3]) / z + image_.cx;
      const double v = image_.fy * (T[4] * p[0] + T[5] * p[1] + T[6] * p[2] + T[7]) / z + image_.cy;
      const int cell = Cells::of(u, v, image_.width, image_.height);
      if (cell >= 0) members[cell].push_back(i);
    }
    return members;
  }

  const AlignImage& image_;
  const AlignPoints& points_;
  std::span<const double, 16> T_world_reference_;
  double a_ = 1.0, b_ = 0.0;
  std::array<double, 3> inverse_{};
  std::array<double, 2> residual_{};
  std::array<double, 12> coupling_{};
  Mat6 H_{};
};

// Reprojection residuals over their σ, Student-t weights: calls take(index, w, Ju, Jv, ru, rv) for each match in view.
template <typename Take>
void for_matches(const AlignMatches& m, std::span<const double, 16> T, Take take) {
  for (std::size_t i = 0; i < m.points.size() / 3; ++i) {
    const double *p = &m.points[3 * i], *pixel = &m.pixels[2 * i];
    const double x = T[0] * p[0] + T[1] * p[1] + T[2] * p[2] + T[3];
    const double y = T[4] * p[0] + T[5] * p[1] + T[6] * p[2] + T[7];
    const double z = T[8] * p[0] + T[9] * p[1] + T[10] * p[2] + T[11];
    if (!(z > 1e-3)) continue;
    const double iz = 1.0 / z;
    const double fx = m.fx / m.sigmas[i], fy = m.fy / m.sigmas[i];
    const double ru = fx * x * iz + (m.cx - pixel[0]) / m.sigmas[i], rv = fy * y * iz + (m.cy - pixel[1]) / m.sigmas[i];
    const double w = 5.0 / (4.0 + ru * ru + rv * rv);
    const double ux = fx * iz, uz = -fx * x * iz * iz, vy = fy * iz, vz = -fy * y * iz * iz;
    const Vec6 Ju = {ux, 0.0, uz, uz * y, ux * z - uz * x, -ux * y};
    const Vec6 Jv = {0.0, vy, vz, vz * y - vy * z, -vz * x, vy * x};
    take(i, w, Ju, Jv, ru, rv);
  }
}

void add_matches(const AlignMatches& m, std::span<const double, 16> T, double weight, Normal& total) {
  for_matches(m, T, [&](std::size_t, double robust, const Vec6& Ju, const Vec6& Jv, double ru, double rv) {
    const double w = weight * robust;
    for (int a = 0; a < 6; ++a) {
      for (int b = 0; b < 6; ++b) total.H[6 * a + b] += w * (Ju[a] * Ju[b] + Jv[a] * Jv[b]);
      total.g[a] += w * (Ju[a] * ru + Jv[a] * rv);
    }
  });
}

// The matches' pixels are of the full image, which is as wide as the finest level's, or a multiple of it.
void scatter_matches(const AlignMatches& m, std::span<const double, 16> T, const AlignImage& finest, double weight,
                     Cells& cells, Mat6& curvature) {
  const double scale = m.fx / finest.fx;
  Mat6 H{};
  Curving curving;
  for_matches(m, T, [&](std::size_t i, double robust, const Vec6& Ju, const Vec6& Jv, double ru, double rv) {
    const double w = weight * robust;
    const int cell = Cells::of(m.pixels[2 * i], m.pixels[2 * i + 1], scale * finest.width, scale * finest.height);
    Vec6 g{};
    Mat6 own{};
    for (int a = 0; a < 6; ++a) {
      g[a] = w * (Ju[a] * ru + Jv[a] * rv);
      for (int b = 0; b < 6; ++b) own[6 * a + b] = w * (Ju[a] * Ju[b] + Jv[a] * Jv[b]);
    }
    if (cell >= 0) cells.add(cell, g, own);
    for (int a = 0; a < 36; ++a) H[a] += own[a];
    curving.add(std::hypot(ru, rv), 4.0);
  });
  for (int i = 0; i < 36; ++i) curvature[i] += curving.share() * H[i];
}

// To first order: the twist from the prior to the pose is small where the prior is kept.
void add_prior(const AlignPrior& prior, std::span<const double, 16> T_camera_world, Normal& total) {
  const Vec6 off = se3_log_near(multiply(T_camera_world, inverse(prior.T_camera_world)));
  for (int i = 0; i < 6; ++i) {
    for (int j = 0; j < 6; ++j) {
      total.H[6 * i + j] += prior.information[6 * i + j];
      total.g[i] += prior.information[6 * i + j] * off[j];
    }
  }
}

// Gauss-Newton on one level.
void descend(std::vector<DenseTerm>& terms, const AlignMatches& matches, const AlignPrior* prior, const AlignPlan& plan,
             const Weights& weights, AlignResult& result) {
  for (int iteration = 0; iteration < plan.iterations; ++iteration) {
    Normal total;
    for (DenseTerm& term : terms) term.add(result.T_camera_world, plan, weights.dense, total);
    add_matches(matches, result.T_camera_world, weights.matches, total);
    result.H = total.H;
    if (prior != nullptr) add_prior(*prior, result.T_camera_world, total);
    const Vec6 step = total.solve();
    result.T_camera_world = multiply(se3_exp(step), result.T_camera_world);
    for (DenseTerm& term : terms) term.follow(step);
    if (std::all_of(step.begin(), step.end(), [](double s) { return std::abs(s) < kStepDone; })) break;
  }
}

// However well residuals agree (a camera at rest before a still scene): the noise is no less than this share.
constexpr double kLeastExcess = 0.05;

// Weights by what the residuals of this frame show: the inverse of each kind's excess over its noise model.
Weights adapted(const std::vector<DenseTerm>& terms, const AlignMatches& matches, const AlignImage& finest,
                const AlignPlan& plan, const Weights& before, const AlignResult& result) {
  Cells dense, sparse;
  Mat6 unused{};
  for (const DenseTerm& term : terms) term.scatter(result.T_camera_world, plan, 1.0, dense, unused);
  scatter_matches(matches, result.T_camera_world, finest, 1.0, sparse, unused);
  const double of_dense = dense.excess(), of_sparse = sparse.excess();
  return {.dense = of_dense > 0.0 ? plan.dense_share / std::max(of_dense, kLeastExcess) : before.dense,
          .matches = of_sparse > 0.0 ? 1.0 / std::max(of_sparse, kLeastExcess) : before.matches};
}

// Ten to a freedom; fewer fit noise, and a step from them may lead anywhere.
constexpr std::size_t kLeastPoints = 60;

// Whether a level says enough of the pose: small levels of distant or patchy surfaces have next to no points.
bool is_worth_a_step(std::size_t level, std::span<const AlignReference> references, const AlignMatches& matches,
                     const AlignPrior* prior) {
  std::size_t n = matches.points.size() / 3;
  for (const AlignReference& reference : references) n += reference.levels[level].gray.size();
  return n >= kLeastPoints || prior != nullptr;
}

}  // namespace

AlignResult align(std::span<const AlignImage> levels, std::span<const AlignReference> references,
                  const AlignMatches& matches, const AlignPrior* prior, std::span<const double, 16> T_start,
                  const AlignPlan& plan) {
  AlignResult result;
  std::copy(T_start.begin(), T_start.end(), result.T_camera_world.begin());
  Weights weights{.dense = plan.dense_weight, .matches = 1.0};
  for (std::size_t level = levels.size(); level-- > plan.finest;) {
    if (level > plan.finest && !is_worth_a_step(level, references, matches, prior)) continue;
    std::vector<DenseTerm> terms;
    for (const AlignReference& reference : references) {
      terms.emplace_back(levels[level], reference.levels[level], reference.T_world_reference);
    }
    descend(terms, matches, prior, plan, weights, result);
    if (level > plan.finest) continue;
    if (plan.dense_share > 0.0) {
      weights = adapted(terms, matches, levels[level], plan, weights, result);
      descend(terms, matches, prior, plan, weights, result);
    }
    Cells cells;
    for (const DenseTerm& term : terms) term.scatter(result.T_camera_world, plan, weights.dense, cells, result.curvature);
    scatter_matches(matches, result.T_camera_world, levels[level], weights.matches, cells, result.curvature);
    cells.report(result);
  }
  result.dense_weight = weights.dense;
  result.match_weight = weights.matches;
  return result;
}

}  // namespace splatbot
