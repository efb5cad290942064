// SPDX-License-Identifier: Apache-2.0
// View-dependent colour of the Gaussians in view and its gradient. The colour is max(0, 1/2 + sum of spherical
// harmonics x coefficients), in the direction from the camera's centre to the Gaussian. Real harmonics with the signs of 3DGS
// (Kerbl et al. 2023; polynomials after Sloan, JCGT 2013). Beyond the unit sphere they continue as these polynomials,
// which has no effect, since only gradients along the sphere are used.
#include "entry.hpp"
#include "lanes.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

constexpr float kBand0 = 0.28209479177387814F;
constexpr float kBand1 = 0.4886025119029199F;
constexpr float kBand2[] = {1.0925484305920792F, 0.31539156525252005F, 0.5462742152960396F};
constexpr float kBand3[] = {-0.5900435899266435F, 2.890611442640554F, -0.4570457994644658F, 0.3731763325901154F,
                            1.445305721320277F};
constexpr float kBand4[] = {2.5033429417967046F, -1.7701307697799304F, 0.9461746957575601F, -0.6690465435572892F,
                            0.10578554691520431F, 0.47308734787878004F, 0.6258357354491761F};

constexpr int count_of(int degree) { return (degree + 1) * (degree + 1); }

struct Direction {
  F unit[3];
  F inverse_length;
};

struct Basis {
  alignas(64) float rows[count_of(kMaxHarmonicsDegree)][W];
};

SB_INLINE Direction direction_of(const HarmonicsArgs& args, const std::uint32_t* ids, int n) {
  alignas(64) float lanes[3][W];
  for (int i = 0; i < W; ++i) {
    const float* mean = args.means + std::size_t{ids[i < n ? i : n - 1]} * 3;
    for (int c = 0; c < 3; ++c) {
      lanes[c][i] = (mean[c] - args.view.origin[c]) - args.view.center_low[c];
    }
  }
  Direction d;
  F squared = set1(0.0F);
  for (int c = 0; c < 3; ++c) {
    d.unit[c] = load(lanes[c]);
    squared = fma(d.unit[c], d.unit[c], squared);
  }
  d.inverse_length = set1(1.0F) / sqrt(max(squared, set1(1e-30F)));
  for (auto& c : d.unit) {
    c = c * d.inverse_length;
  }
  return d;
}

template <int Degree>
SB_INLINE void evaluate(const Direction& d, Basis& out) {
  const F x = d.unit[0], y = d.unit[1], z = d.unit[2];
  const auto put = [&](int k, float scale, F value) { store(out.rows[k], set1(scale) * value); };
  store(out.rows[0], set1(kBand0));
  if constexpr (Degree >= 1) {
    put(1, -kBand1, y);
    put(2, kBand1, z);
    put(3, -kBand1, x);
  }
  const F zz = z * z, one = set1(1.0F), three = set1(3.0F);
  const F cos2 = fma(x, x, -(y * y));      // of twice the longitude, times the sine of the colatitude squared
  const F x3 = fnma(three * y, y, x * x);  // cos(3 longitude) = x x3, sin(3 longitude) = y y3
  const F y3 = fma(three * x, x, -(y * y));
  if constexpr (Degree >= 2) {
    put(4, kBand2[0], x * y);
    put(5, -kBand2[0], y * z);
    put(6, kBand2[1], fma(three, zz, -one));
    put(7, -kBand2[0], x * z);
    put(8, kBand2[2], cos2);
  }
  if constexpr (Degree >= 3) {
    const F ring = fma(set1(5.0F), zz, -one);
    put(9, kBand3[0], y * y3);
    put(10, kBand3[1], x * y * z);
    put(11, kBand3[2], y * ring);
    put(12, kBand3[3], z * fma(set1(5.0F), zz, -three));
    put(13, kBand3[2], x * ring);
    put(14, kBand3[4], z * cos2);
    put(15, kBand3[0], x * x3);
  }
  if constexpr (Degree >= 4) {
    const F ring1 = fma(set1(7.0F), zz, -one), ring3 = fma(set1(7.0F), zz, -three);
    put(16, kBand4[0], x * y * cos2);
    put(17, kBand4[1], y * z * y3);
    put(18, kBand4[2], x * y * ring1);
    put(19, kBand4[3], y * z * ring3);
    put(20, kBand4[4], fma(zz, fma(set1(35.0F), zz, set1(-30.0F)), three));
    put(21, kBand4[3], x * z * ring3);
    put(22, kBand4[5], cos2 * ring1);
    put(23, kBand4[1], x * z * x3);
    put(24, kBand4[6], fnma(y * y, y3, x * x * x3));
  }
}

// Gradient to (x, y, z) of the sum of basis functions weighted by `weights`.
template <int Degree>
SB_INLINE void differentiate(const Direction& d, const Basis& weights, F (&g)[3]) {
  const F x = d.unit[0], y = d.unit[1], z = d.unit[2];
  const auto w = [&](int k, float scale) { return set1(scale) * load(weights.rows[k]); };
  g[0] = w(3, -kBand1);
  g[1] = w(1, -kBand1);
  g[2] = w(2, kBand1);
  const F zz = z * z, xy = x * y, one = set1(1.0F), three = set1(3.0F);
  const F cos2 = fma(x, x, -(y * y));
  const F x3 = fnma(three * y, y, x * x);
  const F y3 = fma(three * x, x, -(y * y));
  if constexpr (Degree >= 2) {
    const F w4 = w(4, kBand2[0]), w5 = w(5, -kBand2[0]), w7 = w(7, -kBand2[0]), w8 = w(8, 2.0F * kBand2[2]);
    g[0] = g[0] + fma(w4, y, fma(w7, z, w8 * x));
    g[1] = g[1] + fma(w4, x, fma(w5, z, -(w8 * y)));
    g[2] = g[2] + fma(w5, y, fma(w7, x, w(6, 6.0F * kBand2[1]) * z));
  }
  if constexpr (Degree >= 3) {
    const F ring = fma(set1(5.0F), zz, -one), three_cos2 = three * cos2, six_xy = set1(6.0F) * xy;
    const F w9 = w(9, kBand3[0]), w10 = w(10, kBand3[1]), w11 = w(11, kBand3[2]), w13 = w(13, kBand3[2]);
    const F w14 = w(14, kBand3[4]), w15 = w(15, kBand3[0]), ten_z = set1(10.0F) * z, two_z = set1(2.0F) * z;
    g[0] = g[0] + fma(w9, six_xy, fma(w10, y * z, fma(w13, ring, fma(w14, two_z * x, w15 * three_cos2))));
    g[1] = g[1] + fma(w9, three_cos2, fma(w10, x * z, fma(w11, ring, -fma(w14, two_z * y, w15 * six_xy))));
    g[2] = g[2] + fma(w10, xy, fma(fma(w11, y, w13 * x), ten_z, w14 * cos2));
    g[2] = fma(w(12, kBand3[3]), fma(set1(15.0F), zz, -three), g[2]);
  }
  if constexpr (Degree >= 4) {
    const F ring1 = fma(set1(7.0F), zz, -one), ring3 = z * fma(set1(7.0F), zz, -three);
    const F turn3 = fma(set1(21.0F), zz, -three), six_xyz = set1(6.0F) * xy * z, three_z_cos2 = three * z * cos2;
    const F w16 = w(16, kBand4[0]), w17 = w(17, kBand4[1]), w18 = w(18, kBand4[2]), w19 = w(19, kBand4[3]);
    const F w21 = w(21, kBand4[3]), w22 = w(22, 2.0F * kBand4[5]), w23 = w(23, kBand4[1]);
    const F w24 = w(24, 4.0F * kBand4[6]), fourteen = set1(14.0F), seven = set1(7.0F);
    g[0] = g[0] + fma(w16, y * y3, fma(w17, six_xyz, fma(w18, y * ring1, fma(w21, ring3, w22 * x * ring1))));
    g[0] = g[0] + fma(w23, three_z_cos2, w24 * x * x3);
    g[1] = g[1] + fma(w16, x * x3, fma(w17, three_z_cos2, fma(w18, x * ring1, fma(w19, ring3, -(w22 * y * ring1)))));
    g[1] = g[1] - fma(w23, six_xyz, w24 * y * y3);
    g[2] = g[2] + fma(w17, y * y3, fma(w18, fourteen * xy * z, fma(fma(w19, y, w21 * x), turn3, w23 * x * x3)));
    g[2] = fma(w22, seven * z * cos2, g[2]);
    g[2] = fma(w(20, kBand4[4]), z * fma(set1(140.0F), zz, set1(-60.0F)), g[2]);
  }
}

template <int Degree>
void color_block(const HarmonicsArgs& args, const std::uint32_t* visible, std::uint32_t count) {
  const auto stride = static_cast<std::size_t>(args.held) * 3;
  Basis basis;
  for (std::uint32_t at = 0; at < count; at += W) {
    const int n = count - at < W ? static_cast<int>(count - at) : W;
    evaluate<Degree>(direction_of(args, visible + at, n), basis);
    for (int i = 0; i < n; ++i) {
      const std::size_t id = visible[at + static_cast<std::uint32_t>(i)];
      const float* from = args.coefficients + id * stride;
      float sum[3] = {0.5F, 0.5F, 0.5F};
      for (int k = 0; k < count_of(Degree); ++k) {
        for (int c = 0; c < 3; ++c) {
          sum[c] += basis.rows[k][i] * from[3 * k + c];
        }
      }
      float* to = args.colors + id * args.color_stride;
      for (int c = 0; c < 3; ++c) {
        to[c] = sum[c] > 0.0F ? sum[c] : 0.0F;
      }
    }
  }
}

struct CenterSums {
  double lanes[3][W];
};

// Into the mean and the camera's centre, which is subtracted from it.
SB_INLINE void move(const HarmonicsBackwardArgs& args, const Direction& d, const std::uint32_t* ids, int n, F (&g)[3],
                    CenterSums& center) {
  const F radial = fma(g[0], d.unit[0], fma(g[1], d.unit[1], g[2] * d.unit[2]));
  alignas(64) float lanes[3][W];
  for (int c = 0; c < 3; ++c) {
    store(lanes[c], fnma(radial, d.unit[c], g[c]) * d.inverse_length);
  }
  for (int i = 0; i < n; ++i) {
    for (int c = 0; c < 3; ++c) {
      center.lanes[c][i] -= static_cast<double>(lanes[c][i]);
      if (args.means != nullptr) {
        args.means[std::size_t{ids[i]} * 3 + static_cast<std::size_t>(c)] += lanes[c][i];
      }
    }
  }
}

void zero_coefficients(const HarmonicsBackwardArgs& args, std::size_t from, std::size_t to) {
  if (args.coefficients != nullptr && !args.accumulate && from < to) {
    const auto stride = static_cast<std::size_t>(args.forward.held) * 3;
    std::memset(args.coefficients + from * stride, 0, (to - from) * stride * sizeof(float));
  }
}

template <int Degree>
void backward_block(const HarmonicsBackwardArgs& args, const std::uint32_t* visible, std::uint32_t count,
                    std::size_t next_row, CenterSums& center) {
  const HarmonicsArgs& f = args.forward;
  const auto held = static_cast<std::size_t>(f.held);
  constexpr int kCount = count_of(Degree);
  const bool moves = Degree > 0 && (args.means != nullptr || args.center != nullptr);
  Basis basis, weights;
  for (std::uint32_t at = 0; at < count; at += W) {
    const std::uint32_t* ids = visible + at;
    const int n = count - at < W ? static_cast<int>(count - at) : W;
    const Direction d = direction_of(f, ids, n);
    evaluate<Degree>(d, basis);
    if (n < W) {
      std::memset(&weights, 0, sizeof(weights));
    }
    for (int i = 0; i < n; ++i) {
      const std::size_t id = ids[i];
      const float* color = f.colors + id * f.color_stride;
      float g[3];
      for (int c = 0; c < 3; ++c) {  // none where the colour is held at 0
        g[c] = color[c] > 0.0F ? args.colors[id * 3 + static_cast<std::size_t>(c)] : 0.0F;
      }
      if (args.coefficients != nullptr) {
        zero_coefficients(args, next_row, id);
        next_row = id + 1;
        float* to = args.coefficients + id * held * 3;
        for (int k = 0; k < kCount; ++k) {
          for (int c = 0; c < 3; ++c) {
            const float value = basis.rows[k][i] * g[c];
            to[3 * k + c] = args.accumulate ? to[3 * k + c] + value : value;
          }
        }
        if (!args.accumulate) {
          std::memset(to + 3 * kCount, 0, (held - kCount) * 3 * sizeof(float));
        }
      }
      const float* from = f.coefficients + id * held * 3;
      for (int k = 1; moves && k < kCount; ++k) {
        weights.rows[k][i] = from[3 * k] * g[0] + from[3 * k + 1] * g[1] + from[3 * k + 2] * g[2];
      }
    }
    if constexpr (Degree > 0) {
      if (moves) {
        F g[3];
        differentiate<Degree>(d, weights, g);
        move(args, d, ids, n, g, center);
      }
    }
  }
}

// Calls each() with the degree as a constant.
template <class Each>
void with_degree(int degree, Each each) {
  switch (degree) {
    case 0:
      return each(Constant<0>{});
    case 1:
      return each(Constant<1>{});
    case 2:
      return each(Constant<2>{});
    case 3:
      return each(Constant<3>{});
    default:
      return each(Constant<4>{});
  }
}

}  // namespace

void harmonics(const HarmonicsArgs& args, std::size_t block) {
  const std::uint32_t* visible = args.visible + block * kProjectBlock;
  const std::uint32_t count = args.blocks[block].visible;
  with_degree(args.degree, [&](auto degree) { color_block<degree>(args, visible, count); });
}

void harmonics_backward(const HarmonicsBackwardArgs& args, std::size_t block) {
  const std::uint32_t* visible = args.forward.visible + block * kProjectBlock;
  const std::uint32_t count = args.forward.blocks[block].visible;
  const BlockRows rows = rows_of_block(block, args.forward.count);
  CenterSums center{};
  with_degree(args.forward.degree,
              [&](auto degree) { backward_block<degree>(args, visible, count, rows.begin, center); });
  zero_coefficients(args, count == 0 ? rows.begin : std::size_t{visible[count - 1]} + 1, rows.end);
  for (int c = 0; c < 3 && args.center != nullptr; ++c) {
    double sum = 0.0;
    for (int i = 0; i < W; ++i) {
      sum += center.lanes[c][i];
    }
    args.center[block * 3 + static_cast<std::size_t>(c)] = sum;
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
