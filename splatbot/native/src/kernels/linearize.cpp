// SPDX-License-Identifier: Apache-2.0
// Photometric and point-to-plane residuals of a chunk of points with their Jacobians, and the sums over them.
#include <limits>

#include "entry.hpp"
#include "simd.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

constexpr int kPoints = kLinearizeChunk;
static_assert(kPoints % 16 == 0);

struct Row {
  alignas(64) float values[kPoints];
};

// Residuals of one kind: Jacobian rows, weights (zero: none) and r.
struct Residuals {
  Row J[8];
  Row weight, r;
};

SB_INLINE F gather(const float* base, I index) {
#if SPLATBOT_SIMD == 512
  return {_mm512_i32gather_ps(index.v, base, 4)};
#elif SPLATBOT_SIMD == 256
  return {_mm256_i32gather_ps(base, index.v, 4)};
#else
  F r;
  for (int i = 0; i < W; ++i) {
    r.v[i] = base[index.v[i]];
  }
  return r;
#endif
}

SB_INLINE F abs(F a) { return max(a, -a); }

SB_INLINE F mix(F a, F low, F high) { return fma(a, high - low, low); }

struct Sample {
  F value, du, dv;
};

// Value of the bilinear interpolant at pixel (x + a, y + b), index = y w + x, and its central differences over a pixel.
SB_INLINE Sample sample_gray(const float* gray, int width, I index, F a, F b) {
  const auto tap = [&](int dx, int dy) { return gather(gray, index + set1(dy * width + dx)); };
  const F above0 = tap(0, -1), above1 = tap(1, -1);
  const F p_1 = tap(-1, 0), p0 = tap(0, 0), p1 = tap(1, 0), p2 = tap(2, 0);
  const F q_1 = tap(-1, 1), q0 = tap(0, 1), q1 = tap(1, 1), q2 = tap(2, 1);
  const F below0 = tap(0, 2), below1 = tap(1, 2);
  const F above = mix(a, above0, above1), here = mix(a, p0, p1), next = mix(a, q0, q1), below = mix(a, below0, below1);
  const F left = mix(b, mix(a, p_1, p0), mix(a, q_1, q0)), right = mix(b, mix(a, p1, p2), mix(a, q1, q2));
  const F half = set1(0.5F);
  return {mix(b, here, next), half * (right - left), half * (mix(b, next, below) - mix(b, above, here))};
}

// Depth between pixels; zero where the four neighbours are not one surface.
SB_INLINE F sample_depth(const float* depth, int width, I index, F a, F b) {
  const F d0 = gather(depth, index), d1 = gather(depth, index + set1(1));
  const F d2 = gather(depth, index + set1(width)), d3 = gather(depth, index + set1(width + 1));
  const F low = min(min(d0, d1), min(d2, d3)), high = max(max(d0, d1), max(d2, d3));
  const M one = (low > set1(0.0F)) & (high - low <= set1(0.05F) * low);
  return zero_unless(one, mix(b, mix(a, d0, d1), mix(a, d2, d3)));
}

// Residuals of the points from k on, where `used`: r, weight of Student's t over σ², their number and their share of
// the cost. `ratios` (may be null) gets r / σ, NaN where not used.
SB_INLINE void weigh(const LinearizeArgs& args, int k, M used, F r, F sigma, Residuals& out, float* ratios,
                     std::size_t& count, F& cost) {
  const F s = r / sigma, s2 = s * s;
  const F nu = set1(args.nu), more = set1(args.nu + 1.0F);
  store(out.r.values + k, zero_unless(used, r));
  store(out.weight.values + k, zero_unless(used, more / ((nu + s2) * sigma * sigma)));
  if (ratios != nullptr) {
    alignas(64) float ratio[W];
    store(ratio, select(used, s, set1(std::numeric_limits<float>::quiet_NaN())));
    for (int i = 0; i < W && k + i < args.count; ++i) {
      ratios[k + i] = ratio[i];
    }
  }
  count += static_cast<std::size_t>(__builtin_popcount(bits(used)));
  cost = cost + zero_unless(used, set1(0.5F * 0.69314718F * (args.nu + 1.0F)) * log2(fma(s2, set1(1.0F / args.nu), set1(1.0F))));
}

// H += Jᵀ W J (upper triangle, n states) and g += Jᵀ W r over a chunk.
template <int N>
void accumulate(const Residuals& residuals, int count, LinearizeSums& sums) {
  for (int i = 0; i < N; ++i) {
    F acc[N + 1];
    for (int j = 0; j <= N; ++j) {
      acc[j] = set1(0.0F);
    }
    for (int k = 0; k < count; k += W) {
      const F scaled = load(residuals.weight.values + k) * load(residuals.J[i].values + k);
#pragma GCC unroll 8
      for (int j = 0; j < N; ++j) {
        if (j >= i) {
          acc[j] = fma(scaled, load(residuals.J[j].values + k), acc[j]);
        }
      }
      acc[N] = fma(scaled, load(residuals.r.values + k), acc[N]);
    }
    for (int j = i; j < N; ++j) {
      sums.H[8 * i + j] += static_cast<double>(total(acc[j]));
    }
    sums.g[i] += static_cast<double>(total(acc[N]));
  }
}

}  // namespace

void linearize(const LinearizeArgs& args, LinearizeSums& sums) {
  Residuals photo, geo;
  Row x, y, z, nx, ny, nz, gray;
  const float* T = args.T;
  const F zero = set1(0.0F), one = set1(1.0F);
  F cost = zero;
  for (int i = 0; i < kPoints; ++i) {  // beyond the end: behind the camera
    const bool in = i < args.count;
    x.values[i] = in ? args.points[3 * i] : 0.0F;
    y.values[i] = in ? args.points[3 * i + 1] : 0.0F;
    z.values[i] = in ? args.points[3 * i + 2] : 0.0F;
    nx.values[i] = in ? args.normals[3 * i] : 0.0F;
    ny.values[i] = in ? args.normals[3 * i + 1] : 0.0F;
    nz.values[i] = in ? args.normals[3 * i + 2] : 0.0F;
    gray.values[i] = in ? args.gray_reference[i] : 0.0F;
  }
  const auto rotate = [T](int row, F a, F b, F c) {
    return fma(set1(T[4 * row]), a, fma(set1(T[4 * row + 1]), b, set1(T[4 * row + 2]) * c));
  };
  const int padded = (args.count + W - 1) / W * W;
  for (int k = 0; k < padded; k += W) {
    const F px = load(x.values + k), py = load(y.values + k), pz = load(z.values + k);
    const F qx = rotate(0, px, py, pz) + set1(T[3]);
    const F qy = rotate(1, px, py, pz) + set1(T[7]);
    const F qz = rotate(2, px, py, pz) + set1(T[11]);
    const F lane = [&] {
      alignas(64) float index[W];
      for (int i = 0; i < W; ++i) {
        index[i] = static_cast<float>(k + i);
      }
      return load(index);
    }();
    const M before = (qz > set1(1e-3F)) & (lane < set1(static_cast<float>(args.count)));
    const F iz = one / select(before, qz, one);
    const F u = fma(set1(args.fx) * qx, iz, set1(args.cx)), v = fma(set1(args.fy) * qy, iz, set1(args.cy));
    // The gradient reads one pixel further on each side. Comparisons are false for NaN.
    const M inside = before & (u >= one) & (v >= one) & (u < set1(static_cast<float>(args.width - 2))) &
                     (v < set1(static_cast<float>(args.height - 2)));
    sums.projected += static_cast<std::size_t>(__builtin_popcount(bits(inside)));
    const F su = select(inside, u, one), sv = select(inside, v, one);
    const F fu = floor(su), fv = floor(sv);
    const F a = su - fu, b = sv - fv;
    const I column = to_int(fu), row = to_int(fv);
    alignas(64) std::uint32_t rows[W];
    store(rows, row);
    alignas(64) std::uint32_t columns[W];
    store(columns, column);
    alignas(64) std::uint32_t flat[W];
    for (int i = 0; i < W; ++i) {
      flat[i] = rows[i] * static_cast<std::uint32_t>(args.width) + columns[i];
    }
    I index;
    std::memcpy(&index.v, flat, sizeof(index.v));

    const F depth = sample_depth(args.depth, args.width, index, a, b);
    const M measured = depth > zero;
    const F sigma_z = fma(set1(args.sigma_depth_quad) * qz, qz, set1(args.sigma_depth_floor));
    // A point far behind or before the camera's surface is occluded or gone: its colour is no evidence either.
    const M contradicted = measured & (abs(depth - qz) > fma(set1(3.0F), sigma_z, set1(args.gate)));
    const M used = and_not(inside, contradicted);

    if (args.use_photometric) {
      const Sample s = sample_gray(args.gray, args.width, index, a, b);
      // Masked pixels are NaN, and so are values interpolated from one.
      const M seen = used & (abs(s.value) + abs(s.du) + abs(s.dv) < set1(1e6F));
      const F reference = load(gray.values + k);
      const F r = s.value - fma(set1(args.gain), reference, set1(args.offset));
      const F gx = s.du * set1(args.fx) * iz, gy = s.dv * set1(args.fy) * iz;
      const F gz = -(fma(gx, qx, gy * qy) * iz);
      const F rows_of_J[8] = {gx, gy, gz, fms(gz, qy, gy * qz), fms(gx, qz, gz * qx), fms(gy, qx, gx * qy), -reference, -one};
      for (int i = 0; i < 8; ++i) {
        store(photo.J[i].values + k, zero_unless(seen, rows_of_J[i]));
      }
      F sigma = set1(args.sigma_gray);
      if (args.blurred) {
        F moved = set1(args.blur[0]) * rows_of_J[0];
        for (int i = 1; i < 6; ++i) {
          moved = fma(set1(args.blur[i]), rows_of_J[i], moved);
        }
        sigma = sqrt(select(seen, fma(moved, moved, sigma * sigma), one));
      }
      weigh(args, k, seen, r, sigma, photo, args.residual_photometric, sums.photometric, cost);
    }
    if (args.use_geometric) {
      const F ax = load(nx.values + k), ay = load(ny.values + k), az = load(nz.values + k);
      const F mx = rotate(0, ax, ay, az), my = rotate(1, ax, ay, az), mz = rotate(2, ax, ay, az);
      const M has_normal = fma(ax, ax, fma(ay, ay, az * az)) > set1(0.25F);
      const M ranged = used & measured & has_normal;
      // Point to plane: n · (P - q) with P the observed point on the same ray, P = q · depth / q.z.
      const F n_q = fma(mx, qx, fma(my, qy, mz * qz));
      const F r = n_q * ((depth - qz) * iz);
      const F length2 = fma(qx, qx, fma(qy, qy, qz * qz));
      const F cosine = abs(n_q) / sqrt(select(ranged, length2, one));
      const F sigma = fma(select(ranged, sigma_z, one), cosine, set1(args.sigma_depth_floor));
      const F rows_of_J[6] = {-mx, -my, -mz, fms(my, qz, mz * qy), fms(mz, qx, mx * qz), fms(mx, qy, my * qx)};
      for (int i = 0; i < 6; ++i) {
        store(geo.J[i].values + k, zero_unless(ranged, rows_of_J[i]));
      }
      weigh(args, k, ranged, r, sigma, geo, args.residual_geometric, sums.geometric, cost);
    }
  }
  if (args.use_photometric) {
    accumulate<8>(photo, padded, sums);
  }
  if (args.use_geometric) {
    accumulate<6>(geo, padded, sums);
  }
  sums.cost += static_cast<double>(total(cost));
}

}  // namespace splatbot::SPLATBOT_KERNELS
