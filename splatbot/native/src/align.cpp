// SPDX-License-Identifier: Apache-2.0
#include "splatbot/align.hpp"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

#include "splatbot/se3.hpp"

namespace splatbot {
namespace {

constexpr double kConvergedStep = 1e-5;  // [m] and [rad]: a smaller step ends a level
constexpr double kDamping = 1e-5;        // share of the mean diagonal of H

constexpr double kMinDepth = 1e-3;  // [m] of points in front of the camera

// Ratio of the Hessian of the robust cost to the Gauss-Newton information, Σ ψ'(r) / Σ ψ(r)/r over Student-t residuals r/σ.
// ψ is the derivative of the cost (Huber 1967).
struct RobustCurvature {
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

  // If half of all residuals exceed σ √ν, the cost has no minimum; the floor of 0.1 keeps the covariance finite.
  double share() const { return weight > 0.0 ? std::max(curvature / weight, 0.1) : 1.0; }
};

// Normal equations of Gauss-Newton, H δ = -g with H = Σ w JᵀJ and g = Σ w Jᵀr.
struct NormalEquations {
  Matrix6 H = Matrix6::Zero();
  Vector6 g = Vector6::Zero();

  // The damped step δ = -(H + λI)⁻¹ g by LDLᵀ, with λ = kDamping tr(H)/6. Zero if H carries no information.
  Vector6 solve() const {
    const double trace = H.trace();
    if (!(trace > 0.0)) return Vector6::Zero();
    const Matrix6 damped = H + kDamping * trace / 6.0 * Matrix6::Identity();
    return damped.ldlt().solve(-g);
  }
};

// Normal equations of the residuals of each cell of the current image.
class CellSums {
 public:
  static constexpr int kCount = kAlignCellColumns * kAlignCellRows;

  // Index of the cell that contains pixel (u, v) of an image of that size. Returns -1 outside the image.
  static int index_of(double u, double v, double width, double height) {
    if (!(u >= 0 && v >= 0 && u < width && v < height)) return -1;
    return static_cast<int>(v * kAlignCellRows / height) * kAlignCellColumns +
           static_cast<int>(u * kAlignCellColumns / width);
  }

  void add(int cell, const NormalEquations& sums) {
    g_[cell] += sums.g;
    H_[cell] += sums.H;
    used_[cell] = true;
  }

  // Ratio of the spread of the cells' gradients to the spread that the noise model predicts. It is 1 for independent
  // residuals with the modelled noise. The gradients are evaluated at the minimum of these residuals. Returns 0 if fewer
  // than twelve cells have residuals.
  double variance_ratio() const {
    NormalEquations total;
    int n = 0;
    for (int c = 0; c < kCount; ++c) {
      n += used_[c] ? 1 : 0;
      total.g += g_[c];
      total.H += H_[c];
    }
    if (n < 2 * 6) return 0.0;
    const Vector6 step = total.solve();
    Vector6 squares = Vector6::Zero();
    for (int c = 0; c < kCount; ++c) squares += (g_[c] + H_[c] * step).cwiseAbs2();
    double ratio = 0.0;
    for (int i = 0; i < 6; ++i)
      if (total.H(i, i) > 0.0) ratio += squares[i] / total.H(i, i) / 6.0;
    return ratio * n / (n - 6);
  }

  // The number of cells that have residuals, Σ g gᵀ over them, and the normal equations of each row of cells.
  void report(AlignResult& result) const {
    Matrix6 spread = Matrix6::Zero();
    for (int c = 0; c < kCount; ++c) {
      if (!used_[c]) continue;
      ++result.cells;
      spread += g_[c] * g_[c].transpose();
      const int band = c / kAlignCellColumns;
      Eigen::Map<Matrix6>(&result.band_H[36 * band]) += H_[c];
      Eigen::Map<Vector6>(&result.band_g[6 * band]) += g_[c];
    }
    result.spread = array_from<6>(spread);
  }

 private:
  std::array<Vector6, kCount> g_ = filled<Vector6>();
  std::array<Matrix6, kCount> H_ = filled<Matrix6>();
  std::array<bool, kCount> used_{};

  template <class M>
  static std::array<M, kCount> filled() {
    std::array<M, kCount> all;
    all.fill(M::Zero());
    return all;
  }
};

// Weight of one residual of each kind.
struct Weights {
  double dense, matches;
};

// The dense residuals of one reference on one level. Each reference has an exposure of its own: current = a · reference + b.
//
// The linearisation has eight unknowns, the twist and the exposure,
//   [H_xx H_xe] [δ]      [g_x]
//   [H_ex H_ee] [ε]  = - [g_e].
// The Schur complement marginalises the exposure: (H_xx - H_xe H_ee⁻¹ H_ex) δ = -(g_x - H_xe H_ee⁻¹ g_e), and
// back-substitution gives ε = -H_ee⁻¹ (g_e + H_ex δ).
class DenseTerm {
 public:
  DenseTerm(const AlignImage& image, const AlignPoints& points, std::span<const double, 16> T_world_reference)
      : image_(image), points_(points), T_world_reference_(pose_from(T_world_reference)) {}

  // Add the marginalised normal equations to `total`. Keeps the blocks that `update_exposure` and `add_cells` use.
  void add(const Pose& T_camera_world, const AlignPlan& plan, double weight, NormalEquations& total) {
    const AlignSums s = linearize(points_, T_camera_world * T_world_reference_, plan.settings, {}, {});
    const std::array<double, 3> inverse = exposure_inverse(s);
    H_ee_inverse_ << inverse[0], inverse[1], inverse[1], inverse[2];
    g_e_ << s.g[6] + kExposurePrior * (a_ - 1.0), s.g[7] + kExposurePrior * b_;
    const Map8 H(s.H.data());
    H_xe_ = H.topRightCorner<6, 2>();
    const Eigen::Matrix<double, 6, 2> gain = H_xe_ * H_ee_inverse_;
    H_ = weight * (H.topLeftCorner<6, 6>() - gain * H_xe_.transpose());
    total.H += H_;
    total.g += weight * (Eigen::Map<const Vector6>(s.g.data()) - gain * g_e_);
  }

  // Add the normal equations of each cell to `cells` and the robust curvature to `curvature`. The exposure is
  // marginalised as in the last call of `add`.
  void add_cells(const Pose& T_camera_world, const AlignPlan& plan, double weight, CellSums& cells,
                 Matrix6& curvature) const {
    RobustCurvature of_photometric, of_geometric;
    const Pose T = T_camera_world * T_world_reference_;
    const Eigen::Matrix<double, 6, 2> gain = H_xe_ * H_ee_inverse_;
    const std::vector<std::vector<std::size_t>> members = by_cell(T);
    std::vector<float> points, normals, gray, r_photometric, r_geometric;
    for (int c = 0; c < CellSums::kCount; ++c) {
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
      const AlignSums s = linearize({points, normals, gray}, T, plan.settings, r_photometric, r_geometric);
      if (s.photometric + s.geometric == 0) continue;
      of_photometric.add(r_photometric, plan.settings.nu);
      of_geometric.add(r_geometric, plan.settings.nu);
      const Map8 H(s.H.data());
      const Eigen::Map<const Eigen::Matrix<double, 8, 1>> g(s.g.data());
      NormalEquations cell;
      cell.g = weight * (g.head<6>() - gain * g.tail<2>());
      cell.H = weight * (H.topLeftCorner<6, 6>() - gain * H.bottomLeftCorner<2, 6>());
      cells.add(c, cell);
    }
    AlignSettings geometric = plan.settings;
    geometric.use_photometric = false;
    const AlignSums s = linearize(points_, T, geometric, {}, {});
    const Matrix6 H_geometric = weight * Map8(s.H.data()).topLeftCorner<6, 6>();
    curvature += of_photometric.share() * (H_ - H_geometric) + of_geometric.share() * H_geometric;
  }

  // Back-substitute the exposure of a twist step.
  void update_exposure(const Vector6& step) {
    const Eigen::Vector2d change = H_ee_inverse_ * (g_e_ + H_xe_.transpose() * step);
    a_ -= change[0];
    b_ -= change[1];
  }

 private:
  using Map8 = Eigen::Map<const Eigen::Matrix<double, 8, 8, Eigen::RowMajor>>;

  AlignSums linearize(const AlignPoints& points, const Pose& T, const AlignSettings& settings,
                      std::span<float> r_photometric, std::span<float> r_geometric) const {
    return linearize_alignment(image_, points, array_from(T), a_, b_, settings, r_photometric, r_geometric);
  }

  // Indices of the points that project into each cell.
  std::vector<std::vector<std::size_t>> by_cell(const Pose& T) const {
    std::vector<std::vector<std::size_t>> members(CellSums::kCount);
    const Eigen::Matrix<double, 3, 4> M = T.matrix().topRows<3>();
    for (std::size_t i = 0; i < points_.gray.size(); ++i) {
      const float* p = &points_.points[3 * i];
      const double z = M(2, 0) * p[0] + M(2, 1) * p[1] + M(2, 2) * p[2] + M(2, 3);
      if (!(z > kMinDepth)) continue;
      const double u = image_.fx * (M(0, 0) * p[0] + M(0, 1) * p[1] + M(0, 2) * p[2] + M(0, 3)) / z + image_.cx;
      const double v = image_.fy * (M(1, 0) * p[0] + M(1, 1) * p[1] + M(1, 2) * p[2] + M(1, 3)) / z + image_.cy;
      const int cell = CellSums::index_of(u, v, image_.width, image_.height);
      if (cell >= 0) members[cell].push_back(i);
    }
    return members;
  }

  const AlignImage& image_;
  const AlignPoints& points_;
  Pose T_world_reference_;
  double a_ = 1.0, b_ = 0.0;
  Eigen::Matrix2d H_ee_inverse_ = Eigen::Matrix2d::Zero();
  Eigen::Vector2d g_e_ = Eigen::Vector2d::Zero();
  Eigen::Matrix<double, 6, 2> H_xe_ = Eigen::Matrix<double, 6, 2>::Zero();
  Matrix6 H_ = Matrix6::Zero();
};

using Jacobian = Eigen::Matrix<double, 2, 6, Eigen::RowMajor>;

constexpr double kMatchNu = 4.0;  // degrees of freedom of the Student-t noise of matches

// Scale residual and Jacobian of a match in a blurred image along its displacement b = J β [σ]. Their variance there is
// 1 + |b|², so both are multiplied by I - (1 - 1/√(1 + |b|²)) b bᵀ / |b|².
void whiten(const Eigen::Map<const Vector6>& blur, Jacobian& J, Eigen::Vector2d& r) {
  const Eigen::Vector2d b = J * blur;
  const double length2 = b.squaredNorm();
  if (!(length2 > 0.0)) return;
  const double share = (1.0 - 1.0 / std::sqrt(1.0 + length2)) / length2;
  const Eigen::Matrix<double, 1, 6> along = b.transpose() * J;
  r -= share * b.dot(r) * b;
  J -= share * b * along;
}

// Call visit(index, w, J, r) for each match in front of the camera. The residual is r = (π(T p) - pixel)/σ with the pinhole
// projection π, and w = (ν + 1)/(ν + |r|²) its Student-t weight. With q = T p, the left perturbation exp(δ) T gives
// dq = [I, -[q]x] δ, hence J = dπ/dq [I, -[q]x] / σ. Blur reduces the weight along its direction.
template <typename Visit>
void for_each_match(const AlignMatches& m, const Pose& T, const AlignSettings& settings, Visit visit) {
  const Eigen::Map<const Vector6> blur(settings.blur.data());
  const bool blurred = !blur.isZero(0.0);
  for (std::size_t i = 0; i < m.points.size() / 3; ++i) {
    const Eigen::Vector3d q = T * Eigen::Vector3d::Map(&m.points[3 * i]);
    const double x = q.x(), y = q.y(), z = q.z();
    if (!(z > kMinDepth)) continue;
    const double* pixel = &m.pixels[2 * i];
    const double iz = 1.0 / z;
    const double fx = m.fx / m.sigmas[i], fy = m.fy / m.sigmas[i];
    Eigen::Vector2d r(fx * x * iz + (m.cx - pixel[0]) / m.sigmas[i], fy * y * iz + (m.cy - pixel[1]) / m.sigmas[i]);
    const double ux = fx * iz, uz = -fx * x * iz * iz, vy = fy * iz, vz = -fy * y * iz * iz;
    Jacobian J;
    J << ux, 0.0, uz, uz * y, ux * z - uz * x, -ux * y,  //
        0.0, vy, vz, vz * y - vy * z, -vz * x, vy * x;
    if (blurred) whiten(blur, J, r);
    visit(i, (kMatchNu + 1.0) / (kMatchNu + r.squaredNorm()), J, r);
  }
}

// H += w JᵀJ and g += w Jᵀr. Plain loops: the compiler unrolls them better than the product of such narrow matrices.
void accumulate(double w, const Jacobian& J, const Eigen::Vector2d& r, NormalEquations& sums) {
  const double *Ju = J.data(), *Jv = J.data() + 6;
  double *H = sums.H.data(), *g = sums.g.data();
  for (int a = 0; a < 6; ++a) {
    for (int b = 0; b < 6; ++b) H[6 * a + b] += w * (Ju[a] * Ju[b] + Jv[a] * Jv[b]);
    g[a] += w * (Ju[a] * r[0] + Jv[a] * r[1]);
  }
}

void add_matches(const AlignMatches& m, const Pose& T, const AlignSettings& settings, double weight,
                 NormalEquations& total) {
  for_each_match(m, T, settings, [&](std::size_t, double robust, const Jacobian& J, const Eigen::Vector2d& r) {
    accumulate(weight * robust, J, r, total);
  });
}

// The pixels of matches belong to the full image. Its width is that of the finest level, or a multiple of it.
void add_cells_of_matches(const AlignMatches& m, const Pose& T, const AlignSettings& settings, const AlignImage& finest,
                          double weight, CellSums& cells, Matrix6& curvature) {
  const double scale = m.fx / finest.fx;
  Matrix6 H = Matrix6::Zero();
  RobustCurvature robust_curvature;
  for_each_match(m, T, settings, [&](std::size_t i, double robust, const Jacobian& J, const Eigen::Vector2d& r) {
    const int cell = CellSums::index_of(m.pixels[2 * i], m.pixels[2 * i + 1], scale * finest.width, scale * finest.height);
    NormalEquations match;
    accumulate(weight * robust, J, r, match);
    if (cell >= 0) cells.add(cell, match);
    H += match.H;
    robust_curvature.add(r.norm(), kMatchNu);
  });
  curvature += robust_curvature.share() * H;
}

// The residual of the prior is log(T T_prior⁻¹). Its Jacobian is the identity to first order, as the twist is small.
void add_prior(const AlignPrior& prior, const Pose& T_camera_world, NormalEquations& total) {
  const Vector6 r = se3_log_near(T_camera_world * pose_from(prior.T_camera_world).inverse());
  const Matrix6 information = Eigen::Map<const Eigen::Matrix<double, 6, 6, Eigen::RowMajor>>(prior.information.data());
  total.H += information;
  total.g += information * r;
}

// State of the optimisation: the pose and the information of its last linearisation, without the prior's.
struct Estimate {
  Pose T_camera_world;
  Matrix6 H = Matrix6::Zero();
  Matrix6 curvature = Matrix6::Zero();
};

// Gauss-Newton on one level with left updates T <- exp(δ) T.
void minimize(std::vector<DenseTerm>& terms, const AlignMatches& matches, const AlignPrior* prior,
              const AlignPlan& plan, const Weights& weights, Estimate& estimate) {
  for (int iteration = 0; iteration < plan.iterations; ++iteration) {
    NormalEquations total;
    for (DenseTerm& term : terms) term.add(estimate.T_camera_world, plan, weights.dense, total);
    add_matches(matches, estimate.T_camera_world, plan.settings, weights.matches, total);
    estimate.H = total.H;
    if (prior != nullptr) add_prior(*prior, estimate.T_camera_world, total);
    const Vector6 step = total.solve();
    estimate.T_camera_world = se3_exp(step) * estimate.T_camera_world;
    for (DenseTerm& term : terms) term.update_exposure(step);
    if (step.cwiseAbs().maxCoeff() < kConvergedStep) break;
  }
}

// Lower bound of the variance ratio. A camera at rest in a static scene has residuals that agree better than its noise.
constexpr double kMinVarianceRatio = 0.05;

// Weights from the residuals of this frame: the inverse of the variance ratio of each kind.
Weights adapted_weights(const std::vector<DenseTerm>& terms, const AlignMatches& matches, const AlignImage& finest,
                        const AlignPlan& plan, const Weights& current, const Pose& T_camera_world) {
  CellSums dense, sparse;
  Matrix6 unused = Matrix6::Zero();
  for (const DenseTerm& term : terms) term.add_cells(T_camera_world, plan, 1.0, dense, unused);
  add_cells_of_matches(matches, T_camera_world, plan.settings, finest, 1.0, sparse, unused);
  const double of_dense = dense.variance_ratio(), of_sparse = sparse.variance_ratio();
  return {.dense = of_dense > 0.0 ? plan.dense_share / std::max(of_dense, kMinVarianceRatio) : current.dense,
          .matches = of_sparse > 0.0 ? 1.0 / std::max(of_sparse, kMinVarianceRatio) : current.matches};
}

// Ten points for each degree of freedom. Fewer points fit noise, and their step can diverge.
constexpr std::size_t kMinPoints = 60;

// Returns whether a level constrains the pose. Coarse levels of distant or patchy surfaces have few points.
bool constrains_pose(std::size_t level, std::span<const AlignReference> references, const AlignMatches& matches,
                     const AlignPrior* prior) {
  std::size_t n = matches.points.size() / 3;
  for (const AlignReference& reference : references) n += reference.levels[level].gray.size();
  return n >= kMinPoints || prior != nullptr;
}

}  // namespace

AlignResult align(std::span<const AlignImage> levels, std::span<const AlignReference> references,
                  const AlignMatches& matches, const AlignPrior* prior, std::span<const double, 16> T_start,
                  const AlignPlan& plan) {
  AlignResult result;
  Estimate estimate{.T_camera_world = pose_from(T_start)};
  Weights weights{.dense = plan.dense_weight, .matches = 1.0};
  for (std::size_t level = levels.size(); level-- > plan.finest;) {
    if (level > plan.finest && !constrains_pose(level, references, matches, prior)) continue;
    std::vector<DenseTerm> terms;
    for (const AlignReference& reference : references) {
      terms.emplace_back(levels[level], reference.levels[level], reference.T_world_reference);
    }
    minimize(terms, matches, prior, plan, weights, estimate);
    if (level > plan.finest) continue;
    if (plan.dense_share > 0.0) {
      weights = adapted_weights(terms, matches, levels[level], plan, weights, estimate.T_camera_world);
      minimize(terms, matches, prior, plan, weights, estimate);
    }
    CellSums cells;
    const Pose& T = estimate.T_camera_world;
    for (const DenseTerm& term : terms) term.add_cells(T, plan, weights.dense, cells, estimate.curvature);
    add_cells_of_matches(matches, T, plan.settings, levels[level], weights.matches, cells, estimate.curvature);
    cells.report(result);
  }
  result.T_camera_world = array_from(estimate.T_camera_world);
  result.H = array_from<6>(estimate.H);
  result.curvature = array_from<6>(estimate.curvature);
  result.dense_weight = weights.dense;
  result.match_weight = weights.matches;
  return result;
}

}  // namespace splatbot
