// SPDX-License-Identifier: Apache-2.0
#include "splatbot/align.hpp"

#include <algorithm>
#include <cmath>

#include "splatbot/kernels.hpp"

namespace splatbot {
namespace {

using Mat4 = std::array<double, 16>;
using Vec6 = std::array<double, 6>;
using Mat6 = std::array<double, 36>;

// Exposure is anchored weakly to gain 1 and offset 0, so that a blank image leaves it defined.
constexpr double kExposurePrior = 1e2;
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

// One reference on one level, with that pair's own exposure (a, b).
class DenseTerm {
 public:
  DenseTerm(const AlignImage& image, const AlignPoints& points, std::span<const double, 16> T_world_reference)
      : image_(image), points_(points), T_world_reference_(T_world_reference) {}

  // Add this term, exposure marginalised (Schur complement); remember how exposure would follow a step.
  void add(std::span<const double, 16> T_camera_world, const AlignPlan& plan, Normal& total) {
    const Mat4 T = multiply(T_camera_world, T_world_reference_);
    const AlignSums s = linearize_alignment(image_, points_, T, a_, b_, plan.settings, {}, {});
    const double A00 = s.H[54] + kExposurePrior, A01 = s.H[55], A11 = s.H[63] + kExposurePrior;
    const double det = A00 * A11 - A01 * A01;
    inverse_ = {A11 / det, -A01 / det, A00 / det};
    residual_ = {s.g[6] + kExposurePrior * (a_ - 1.0), s.g[7] + kExposurePrior * b_};
    for (int i = 0; i < 6; ++i) {
      coupling_[2 * i] = s.H[8 * i + 6];
      coupling_[2 * i + 1] = s.H[8 * i + 7];
    }
    for (int i = 0; i < 6; ++i) {
      const double c0 = coupling_[2 * i], c1 = coupling_[2 * i + 1];
      const double k0 = c0 * inverse_[0] + c1 * inverse_[1], k1 = c0 * inverse_[1] + c1 * inverse_[2];
      for (int j = 0; j < 6; ++j)
        total.H[6 * i + j] += plan.dense_weight * (s.H[8 * i + j] - k0 * coupling_[2 * j] - k1 * coupling_[2 * j + 1]);
      total.g[i] += plan.dense_weight * (s.g[i] - k0 * residual_[0] - k1 * residual_[1]);
    }
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
  const AlignImage& image_;
  const AlignPoints& points_;
  std::span<const double, 16> T_world_reference_;
  double a_ = 1.0, b_ = 0.0;
  std::array<double, 3> inverse_{};
  std::array<double, 2> residual_{};
  std::array<double, 12> coupling_{};
};

// Reprojection residuals, σ = 1 px, Student-t weights.
void add_matches(const AlignMatches& m, std::span<const double, 16> T, Normal& total) {
  for (std::size_t i = 0; i < m.points.size() / 3; ++i) {
    const double *p = &m.points[3 * i], *pixel = &m.pixels[2 * i];
    const double x = T[0] * p[0] + T[1] * p[1] + T[2] * p[2] + T[3];
    const double y = T[4] * p[0] + T[5] * p[1] + T[6] * p[2] + T[7];
    const double z = T[8] * p[0] + T[9] * p[1] + T[10] * p[2] + T[11];
    if (!(z > 1e-3)) continue;
    const double iz = 1.0 / z;
    const double ru = m.fx * x * iz + m.cx - pixel[0], rv = m.fy * y * iz + m.cy - pixel[1];
    const double w = 5.0 / (4.0 + ru * ru + rv * rv);
    const double ux = m.fx * iz, uz = -m.fx * x * iz * iz, vy = m.fy * iz, vz = -m.fy * y * iz * iz;
    const double Ju[6] = {ux, 0.0, uz, uz * y, ux * z - uz * x, -ux * y};
    const double Jv[6] = {0.0, vy, vz, vz * y - vy * z, -vz * x, vy * x};
    for (int a = 0; a < 6; ++a) {
      for (int b = 0; b < 6; ++b) total.H[6 * a + b] += w * (Ju[a] * Ju[b] + Jv[a] * Jv[b]);
      total.g[a] += w * (Ju[a] * ru + Jv[a] * rv);
    }
  }
}

}  // namespace

AlignSums linearize_alignment(const AlignImage& image, const AlignPoints& reference, std::span<const double, 16> T,
                              double gain, double offset, const AlignSettings& settings,
                              std::span<float> residual_photometric, std::span<float> residual_geometric) {
  const auto f = [](double value) { return static_cast<float>(value); };
  LinearizeSums sums{};
  LinearizeArgs args{.width = image.width,
                     .height = image.height,
                     .fx = f(image.fx),
                     .fy = f(image.fy),
                     .cx = f(image.cx),
                     .cy = f(image.cy),
                     .gray = image.gray.data(),
                     .depth = image.depth.data(),
                     .count = 0,
                     .points = nullptr,
                     .normals = nullptr,
                     .gray_reference = nullptr,
                     .T = {},
                     .gain = f(gain),
                     .offset = f(offset),
                     .use_photometric = settings.use_photometric,
                     .use_geometric = settings.use_geometric,
                     .sigma_gray = f(settings.sigma_gray),
                     .sigma_depth_floor = f(settings.sigma_depth_floor),
                     .sigma_depth_quad = f(settings.sigma_depth_quad),
                     .gate = f(settings.gate),
                     .nu = f(settings.nu),
                     .residual_photometric = nullptr,
                     .residual_geometric = nullptr};
  std::transform(T.begin(), T.begin() + 12, args.T, f);
  std::fill(residual_photometric.begin(), residual_photometric.end(), std::nanf(""));
  std::fill(residual_geometric.begin(), residual_geometric.end(), std::nanf(""));
  const std::size_t n = reference.gray.size();
  for (std::size_t first = 0; first < n; first += kLinearizeChunk) {
    args.count = static_cast<int>(std::min<std::size_t>(kLinearizeChunk, n - first));
    args.points = reference.points.data() + 3 * first;
    args.normals = reference.normals.data() + 3 * first;
    args.gray_reference = reference.gray.data() + first;
    args.residual_photometric = residual_photometric.empty() ? nullptr : residual_photometric.data() + first;
    args.residual_geometric = residual_geometric.empty() ? nullptr : residual_geometric.data() + first;
    kernels().linearize(args, sums);
  }
  AlignSums out;
  for (int i = 0; i < 8; ++i) {
    for (int j = 0; j < 8; ++j) out.H[8 * i + j] = sums.H[8 * std::min(i, j) + std::max(i, j)];
    out.g[i] = sums.g[i];
  }
  out.cost = sums.cost;
  out.projected = sums.projected;
  out.photometric = sums.photometric;
  out.geometric = sums.geometric;
  return out;
}

AlignResult align(std::span<const AlignImage> levels, std::span<const AlignReference> references,
                  const AlignMatches& matches, std::span<const double, 16> T_start, const AlignPlan& plan) {
  AlignResult result;
  std::copy(T_start.begin(), T_start.end(), result.T_camera_world.begin());
  for (std::size_t level = levels.size(); level-- > plan.finest;) {
    std::vector<DenseTerm> terms;
    for (const AlignReference& reference : references) {
      terms.emplace_back(levels[level], reference.levels[level], reference.T_world_reference);
    }
    for (int iteration = 0; iteration < plan.iterations; ++iteration) {
      Normal total;
      for (DenseTerm& term : terms) term.add(result.T_camera_world, plan, total);
      add_matches(matches, result.T_camera_world, total);
      result.H = total.H;
      const Vec6 step = total.solve();
      result.T_camera_world = multiply(se3_exp(step), result.T_camera_world);
      for (DenseTerm& term : terms) term.follow(step);
      if (std::all_of(step.begin(), step.end(), [](double s) { return std::abs(s) < kStepDone; })) break;
    }
  }
  return result;
}

}  // namespace splatbot
