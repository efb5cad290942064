// SPDX-License-Identifier: Apache-2.0
// From the sums of blend_backward() to the gradients of the inputs, W Gaussians at once. The projection is computed
// anew: cheaper than keeping it.
#include "entry.hpp"
#include "project.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

struct LaneSums {
  alignas(64) float moments[kMoments][W];
  alignas(64) float depth[W];
  alignas(64) float slope_x[W], slope_y[W];    // of plane depth, else 0
  alignas(64) float absolute_x[W], absolute_y[W];
};

struct LaneGradients {
  F mean[3], quat[4], scale[3], covar[6];
  F mean2d[2];
  F rotation[9], translation[3];  // of the camera; mean less origin times translation is yet to be added
  F intrinsics[4];                // fx, fy, cx, cy
};

// Sum of a Gaussian's slots in the order of its tiles, on top of what earlier passes left.
SB_INLINE void sum_slots(const ProjectBackwardArgs& args, const ProjectedBlock& block, std::size_t id, float* sums) {
  const Placement& place = args.forward.placements[id];
  const float* slot = args.slots + (block.first_pair + place.slot) * kSlot;
  const std::size_t pairs = std::size_t{place.nx} * place.ny;
  constexpr int kVectors = kSlot / W;
  F acc[kVectors];
#pragma GCC unroll 4
  for (int i = 0; i < kVectors; ++i) {
    acc[i] = load(slot + i * W);
  }
  for (std::size_t p = 1; p < pairs; ++p) {
#pragma GCC unroll 4
    for (int i = 0; i < kVectors; ++i) {
      acc[i] = acc[i] + load(slot + p * kSlot + static_cast<std::size_t>(i * W));
    }
  }
#pragma GCC unroll 4
  for (int i = 0; i < kVectors; ++i) {
    store(sums + i * W, acc[i]);
  }
}

SB_INLINE void put(float* to, float value, bool add) { *to = add ? *to + value : value; }

void write_colors(const ProjectBackwardArgs& args, std::size_t id, const float* sums) {
  const ChannelPass& pass = *args.pass;
  const int depth = pass.depth_first ? 1 : 0;
  float* to = args.colors + id * static_cast<std::size_t>(args.forward.channels) + pass.first_color;
  for (int c = depth; c < pass.count; ++c) {
    put(to + c - depth, sums[kMoments + c], args.accumulate_colors);
  }
}

// What reaches the projection: gradients to the 2D centre, the 2D covariance and the depth.
struct ImageGradients {
  F mx, my, z;
  F g00, g01, g11;  // d loss = g00 d c00 + 2 g01 d c01 + g11 d c11
};

SB_INLINE ImageGradients from_sums(const LaneSums& sums, const Root& root, const Projected& o, bool antialiased) {
  const F l11 = root.l11, l21 = root.l21, l22 = root.l22;
  // With z = B d and log(alpha) = log(opacity) - |z|^2 / (2 k^2): d/d mean = B^T z / k^2 and
  // d/d covariance = B^T z z^T B / (2 k^4).
  const F su = load(sums.moments[1]), sw = load(sums.moments[2]);
  const F suu = load(sums.moments[3]), suw = load(sums.moments[4]), sww = load(sums.moments[5]);
  constexpr float kInverse = 1.0F / kHalfLog2e;
  ImageGradients g;
  g.z = load(sums.depth);
  // Plane depth at a pixel falls by the slope as the centre moves.
  g.mx = fnma(load(sums.slope_x), g.z, set1(kInverse) * l11 * su);
  g.my = fnma(load(sums.slope_y), g.z, set1(kInverse) * fma(l21, su, l22 * sw));
  const F half = set1(0.5F * kInverse * kInverse);
  g.g00 = half * l11 * l11 * suu;
  g.g01 = half * l11 * fma(l21, suu, l22 * suw);
  g.g11 = half * fma(l21 * l21, suu, fma(set1(2.0F) * l21 * l22, suw, l22 * l22 * sww));
  if (antialiased) {
    // log(opacity) holds log(q) / 2 with q = det_sharp / det; none where q is held at its least.
    const F q = antialias_squared(o);
    const M free = q > set1(kMinAntialias * kMinAntialias);
    const F h = zero_unless(free, set1(0.5F) * load(sums.moments[0]) / (q * o.det));
    g.g00 = fma(h, fnma(q, o.c11, o.s11), g.g00);
    g.g11 = fma(h, fnma(q, o.c00, o.s00), g.g11);
    g.g01 = fnma(h, fnma(q, o.c01, o.c01), g.g01);
  }
  return g;
}

// Gradients to the linearisation: to its rows, which are functions of the columns of a and of the slopes, and to j.
struct RowGradients {
  F rows[2][3];
  F jx, jy;
};

SB_INLINE RowGradients into_axes(const GaussianLanes& g, const Projected& o, const ImageGradients& image, LaneGradients& out) {
  RowGradients r;
  r.jx = r.jy = set1(0.0F);
  const F two = set1(2.0F);
  for (int k = 0; k < 3; ++k) {
    const F gm0 = two * fma(image.g00, o.m[0][k], image.g01 * o.m[1][k]);
    const F gm1 = two * fma(image.g01, o.m[0][k], image.g11 * o.m[1][k]);
    out.scale[k] = fma(o.jx * o.rows[0][k], gm0, o.jy * o.rows[1][k] * gm1);
    r.jx = fma(o.rows[0][k] * g.scale[k], gm0, r.jx);
    r.jy = fma(o.rows[1][k] * g.scale[k], gm1, r.jy);
    r.rows[0][k] = o.jx * g.scale[k] * gm0;
    r.rows[1][k] = o.jy * g.scale[k] * gm1;
  }
  return r;
}

SB_INLINE RowGradients into_covar(const Projected& o, const ImageGradients& image, LaneGradients& out) {
  RowGradients r;
  r.jx = r.jy = set1(0.0F);
  const F two = set1(2.0F);
  F b[2][3];
  for (int k = 0; k < 3; ++k) {
    b[0][k] = o.jx * o.rows[0][k];
    b[1][k] = o.jy * o.rows[1][k];
    const F gb0 = two * fma(image.g00, o.m[0][k], image.g01 * o.m[1][k]);
    const F gb1 = two * fma(image.g01, o.m[0][k], image.g11 * o.m[1][k]);
    r.jx = fma(o.rows[0][k], gb0, r.jx);
    r.jy = fma(o.rows[1][k], gb1, r.jy);
    r.rows[0][k] = o.jx * gb0;
    r.rows[1][k] = o.jy * gb1;
  }
  int at = 0;
  for (int i = 0; i < 3; ++i) {
    for (int j = i; j < 3; ++j) {
      const F mixed = fma(b[0][i], b[1][j], b[1][i] * b[0][j]);
      const F entry = fma(image.g00, b[0][i] * b[0][j], fma(image.g01, mixed, image.g11 * b[1][i] * b[1][j]));
      out.covar[at++] = i == j ? entry : two * entry;  // an entry off the diagonal stands for two
    }
  }
  return r;
}

// Into the unit quaternion from the gradient to a = camera rotation x Gaussian rotation.
SB_INLINE void into_quat(const CameraLanes& cam, const Projected& o, const F (&ga)[9], LaneGradients& out) {
  F r[9];  // d loss / d Gaussian rotation
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      r[3 * i + j] = fma(cam.r[i], ga[j], fma(cam.r[3 + i], ga[3 + j], cam.r[6 + i] * ga[6 + j]));
    }
  }
  const F two = set1(2.0F);
  const F w = o.unit[0], x = o.unit[1], y = o.unit[2], z = o.unit[3];
  F q[4];
  q[0] = two * fma(x, r[7] - r[5], fma(y, r[2] - r[6], z * (r[3] - r[1])));
  q[1] = two * (fma(y, r[1] + r[3], fma(z, r[2] + r[6], w * (r[7] - r[5]))) - two * x * (r[4] + r[8]));
  q[2] = two * (fma(x, r[1] + r[3], fma(z, r[5] + r[7], w * (r[2] - r[6]))) - two * y * (r[0] + r[8]));
  q[3] = two * (fma(x, r[2] + r[6], fma(y, r[5] + r[7], w * (r[3] - r[1]))) - two * z * (r[0] + r[4]));
  const F radial = fma(q[0], w, fma(q[1], x, fma(q[2], y, q[3] * z)));
  const F zero = set1(0.0F);
  for (int i = 0; i < 4; ++i) {
    out.quat[i] = select(o.quat_zero, zero, fnma(radial, o.unit[i], q[i]) / o.norm);
  }
}

// Gradient of the 2D mean and covariance into the Gaussian and the camera; into the latter and the quaternion only if
// wanted.
void pull_back(const GaussianLanes& g, const CameraLanes& cam, const Projected& o, const ImageGradients& image,
               bool of_covar, bool camera, bool quat, LaneGradients& out) {
  const RowGradients r = of_covar ? into_covar(o, image, out) : into_axes(g, o, image, out);
  F ga[9];
  F gsx = set1(0.0F), gsy = set1(0.0F);
  for (int k = 0; k < 3; ++k) {
    gsx = fnma(o.a[6 + k], r.rows[0][k], gsx);
    gsy = fnma(o.a[6 + k], r.rows[1][k], gsy);
    ga[k] = r.rows[0][k];
    ga[3 + k] = r.rows[1][k];
    ga[6 + k] = -fma(o.slope[0], r.rows[0][k], o.slope[1] * r.rows[1][k]);
  }

  // mx = jx px + cx, jx = fx / z, slope = p / z; a clamped slope is a function of the intrinsics alone.
  const F iz = set1(1.0F) / o.p[2];
  const F held_x = gsx - zero_unless(o.slope_free[0], gsx), held_y = gsy - zero_unless(o.slope_free[1], gsy);
  gsx = zero_unless(o.slope_free[0], gsx);
  gsy = zero_unless(o.slope_free[1], gsy);
  const F gjx = fma(image.mx, o.p[0], r.jx);
  const F gjy = fma(image.my, o.p[1], r.jy);
  if (camera) {
    // j x (a - slope a') has a derivative of a / z to the focal length where the slope is clamped: j x slope is
    // constant then.
    const F clamped_x = dot3(o.a, r.rows[0]) / cam.fx, clamped_y = dot3(o.a + 3, r.rows[1]) / cam.fy;
    out.intrinsics[0] = fma(image.mx * o.p[0], iz, select(o.slope_free[0], r.jx * iz, clamped_x));
    out.intrinsics[1] = fma(image.my * o.p[1], iz, select(o.slope_free[1], r.jy * iz, clamped_y));
    out.intrinsics[2] = image.mx - held_x / cam.fx;
    out.intrinsics[3] = image.my - held_y / cam.fy;
  }
  out.mean2d[0] = image.mx;
  out.mean2d[1] = image.my;
  F gp[3];
  gp[0] = fma(image.mx, o.jx, gsx * iz);
  gp[1] = fma(image.my, o.jy, gsy * iz);
  const F along = fma(gjx, o.jx, fma(gjy, o.jy, fma(gsx, o.slope[0], gsy * o.slope[1])));
  gp[2] = fnma(along, iz, image.z);

  for (int i = 0; i < 3; ++i) {
    out.mean[i] = fma(cam.r[i], gp[0], fma(cam.r[3 + i], gp[1], cam.r[6 + i] * gp[2]));
    out.translation[i] = gp[i];
    for (int j = 0; camera && j < 3; ++j) {  // a = camera rotation x Gaussian rotation, or the former alone
      const F turned = of_covar ? ga[3 * i + j]
                                : fma(ga[3 * i], o.rotation[3 * j],
                                      fma(ga[3 * i + 1], o.rotation[3 * j + 1], ga[3 * i + 2] * o.rotation[3 * j + 2]));
      out.rotation[3 * i + j] = fma(gp[i], g.mean[j], turned);
    }
  }
  if (quat) {
    into_quat(cam, o, ga, out);
  }
}

template <int Width>
SB_INLINE void gather_lanes(const float* rows, const std::uint32_t* ids, int n, F (&out)[Width]) {
  alignas(64) float lanes[Width][W];
  for (int i = 0; i < W; ++i) {
    const float* row = rows + static_cast<std::size_t>(ids[i < n ? i : n - 1]) * Width;
    for (int c = 0; c < Width; ++c) {
      lanes[c][i] = row[c];
    }
  }
  for (int c = 0; c < Width; ++c) {
    out[c] = load(lanes[c]);
  }
}

template <int Width>
SB_INLINE void scatter_lanes(float* rows, const std::uint32_t* ids, int n, const F (&values)[Width], bool add) {
  if (rows == nullptr) {
    return;
  }
  alignas(64) float lanes[Width][W];
  for (int c = 0; c < Width; ++c) {
    store(lanes[c], values[c]);
  }
  for (int i = 0; i < n; ++i) {
    float* row = rows + static_cast<std::size_t>(ids[i]) * Width;
    for (int c = 0; c < Width; ++c) {
      put(row + c, lanes[c][i], add);
    }
  }
}

void scatter_covars(float* rows, const std::uint32_t* ids, int n, const F (&upper)[6], bool add) {
  const F zero = set1(0.0F);
  const F all[9] = {upper[0], upper[1], upper[2], zero, upper[3], upper[4], zero, zero, upper[5]};
  scatter_lanes<9>(rows, ids, n, all, add);
}

struct CameraSums {
  double lanes[kCameraSums][W];
};

SB_INLINE void add_camera(const LaneGradients& g, int n, CameraSums& sums) {
  alignas(64) float lanes[kCameraSums][W];
  for (int i = 0; i < 9; ++i) {
    store(lanes[i], g.rotation[i]);
  }
  for (int i = 0; i < 3; ++i) {
    store(lanes[9 + i], g.translation[i]);
  }
  for (int i = 0; i < 4; ++i) {
    store(lanes[12 + i], g.intrinsics[i]);
  }
  for (int k = 0; k < kCameraSums; ++k) {
    for (int i = 0; i < W; ++i) {
      sums.lanes[k][i] += i < n ? static_cast<double>(lanes[k][i]) : 0.0;
    }
  }
}

void gather_covars(const float* rows, const std::uint32_t* ids, int n, F (&out)[6]) {
  F all[9];
  gather_lanes<9>(rows, ids, n, all);
  const int upper[6] = {0, 1, 2, 4, 5, 8};
  for (int i = 0; i < 6; ++i) {
    out[i] = all[upper[i]];
  }
}

void write_gradients(const ProjectBackwardArgs& args, const std::uint32_t* ids, int n, const LaneGradients& grads,
                     const LaneSums& sums, const Root& root) {
  scatter_lanes<3>(args.means, ids, n, grads.mean, args.accumulate);
  scatter_lanes<4>(args.quats, ids, n, grads.quat, args.accumulate);
  scatter_lanes<3>(args.scales, ids, n, grads.scale, args.accumulate);
  if (args.covars != nullptr) {
    scatter_covars(args.covars, ids, n, grads.covar, args.accumulate);
  }
  if (args.opacities != nullptr) {
    F opacity[1];
    gather_lanes<1>(args.forward.opacities, ids, n, opacity);
    const F gradient[1] = {load(sums.moments[0]) / opacity[0]};
    scatter_lanes<1>(args.opacities, ids, n, gradient, args.accumulate);
  }
  scatter_lanes<2>(args.means2d, ids, n, grads.mean2d, false);
  if (args.absolute2d != nullptr) {
    const F scale = set1(1.0F / kHalfLog2e);
    const F absolute[2] = {scale * root.l11 * load(sums.absolute_x), scale * load(sums.absolute_y)};
    scatter_lanes<2>(args.absolute2d, ids, n, absolute, false);
  }
}

void zero_rows(const ProjectBackwardArgs& args, std::size_t begin, std::size_t end) {
  const auto clear = [&](float* rows, std::size_t width) {
    if (rows != nullptr) {
      std::memset(rows + begin * width, 0, (end - begin) * width * sizeof(float));
    }
  };
  if (args.first && !args.accumulate_colors) {
    clear(args.colors, static_cast<std::size_t>(args.forward.channels));
  }
  if (args.last) {
    clear(args.means2d, 2);
    clear(args.absolute2d, 2);
  }
  if (args.last && !args.accumulate) {
    clear(args.means, 3);
    clear(args.quats, 4);
    clear(args.scales, 3);
    clear(args.covars, 9);
    clear(args.opacities, 1);
  }
}

// The sums of W Gaussians, lane by lane; colour gradients are written on the way.
void collect(const ProjectBackwardArgs& args, const ProjectedBlock& block, const std::uint32_t* ids, int n,
             LaneSums& lanes) {
  alignas(64) float sums[kSlot];
  const bool plane = args.forward.options.plane_depth && args.forward.options.depth != DepthMode::none;
  for (int i = 0; i < W; ++i) {
    if (i >= n) {
      for (auto& moment : lanes.moments) {
        moment[i] = 0.0F;
      }
      lanes.depth[i] = lanes.slope_x[i] = lanes.slope_y[i] = lanes.absolute_x[i] = lanes.absolute_y[i] = 0.0F;
      continue;
    }
    const std::size_t id = ids[i];
    sum_slots(args, block, id, sums);
    if (args.colors != nullptr) {
      write_colors(args, id, sums);
    }
    float depth = args.depth_in_pass && args.channel_sums > 0 ? sums[kMoments] : 0.0F;
    if (args.carried != nullptr) {  // moments, then depth, then absolute gradients
      float* carried = args.carried + id * kSlot;
      if (!args.first) {
        for (int k = 0; k < kMoments; ++k) {
          sums[k] += carried[k];
        }
        depth += carried[kMoments];
        sums[kAbsolute] += carried[kAbsolute];
        sums[kAbsolute + 1] += carried[kAbsolute + 1];
      }
      for (int k = 0; k < kMoments; ++k) {
        carried[k] = sums[k];
      }
      carried[kMoments] = depth;
      carried[kAbsolute] = sums[kAbsolute];
      carried[kAbsolute + 1] = sums[kAbsolute + 1];
    }
    for (int k = 0; k < kMoments; ++k) {
      lanes.moments[k][i] = sums[k];
    }
    lanes.depth[i] = depth;
    lanes.absolute_x[i] = sums[kAbsolute];
    lanes.absolute_y[i] = sums[kAbsolute + 1];
    lanes.slope_x[i] = plane ? args.forward.records[id].channels[kRecordChannels - 2] : 0.0F;
    lanes.slope_y[i] = plane ? args.forward.records[id].channels[kRecordChannels - 1] : 0.0F;
  }
}

}  // namespace

void project_backward(const ProjectBackwardArgs& args, std::size_t b) {
  const std::size_t begin = b * kProjectBlock;
  const std::size_t end = begin + kProjectBlock < args.forward.count ? begin + kProjectBlock : args.forward.count;
  const ProjectedBlock& block = args.blocks[b];
  const std::uint32_t* visible = args.forward.visible + begin;
  if (block.visible < end - begin) {
    zero_rows(args, begin, end);
  }
  CameraSums camera_sums{};
  const bool of_covar = args.forward.covars != nullptr;
  const CameraLanes cam(args.forward.view);
  for (std::uint32_t at = 0; at < block.visible; at += W) {
    const std::uint32_t* ids = visible + at;
    const int n = block.visible - at < W ? static_cast<int>(block.visible - at) : W;
    LaneSums sums;
    collect(args, block, ids, n, sums);
    if (!args.last || !args.geometry) {
      continue;
    }
    GaussianLanes g;
    gather_lanes<3>(args.forward.means, ids, n, g.mean);
    from_origin(cam, g.mean);
    if (of_covar) {
      gather_covars(args.forward.covars, ids, n, g.covar);
    } else {
      gather_lanes<4>(args.forward.quats, ids, n, g.quat);
      gather_lanes<3>(args.forward.scales, ids, n, g.scale);
    }
    Projected o;
    project_center(g, cam, o);
    project_rest(g, cam, set1(args.forward.options.eps2d), of_covar, o);
    const Root root = root_of_inverse(o);
    LaneGradients grads;
    pull_back(g, cam, o, from_sums(sums, root, o, args.forward.options.antialiased), of_covar,
              args.camera != nullptr, args.quats != nullptr, grads);
    write_gradients(args, ids, n, grads, sums, root);
    if (args.camera != nullptr) {
      add_camera(grads, n, camera_sums);
    }
  }
  if (args.camera != nullptr && args.last) {
    for (int k = 0; k < kCameraSums; ++k) {
      double sum = 0.0;
      for (int i = 0; i < W; ++i) {
        sum += camera_sums.lanes[k][i];
      }
      args.camera[b * kCameraSums + static_cast<std::size_t>(k)] = sum;
    }
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
