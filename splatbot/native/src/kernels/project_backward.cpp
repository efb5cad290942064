// SPDX-License-Identifier: Apache-2.0
// Propagates the sums of blend_backward() to the gradients of the inputs, W Gaussians at once. The projection is
// computed again: cheaper than keeping it.
#include "entry.hpp"
#include "lanes.hpp"
#include "project.hpp"
#include "unscented.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

struct LaneSums {
  F moments[kMoments];
  F depth;
  F slope[2];     // of plane depth, else 0
  F absolute[2];  // if wanted
};

struct LaneGradients {
  F mean[3], quat[4], scale[3], covar[6];
  F mean2d[2];
  F rotation[9], translation[3];  // of the camera; mean less origin times translation is yet to be added
  F intrinsics[4];                // fx, fy, cx, cy
  MotionLanes moved;              // of a rolling shutter
};

// Adds a Gaussian's slots, in the order of its tiles, to the sums of earlier passes.
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

void write_colors(const ProjectBackwardArgs& args, std::size_t id, const float* sums) {
  const ChannelPass& pass = *args.pass;
  const int depth = pass.depth_first ? 1 : 0;
  float* to = args.colors + id * static_cast<std::size_t>(args.forward.channels) + pass.first_color;
  for (int c = depth; c < pass.count; ++c) {
    put(to + c - depth, sums[kMoments + c], args.accumulate_colors);
  }
}

// Gradients that reach the projection: to the 2D centre, the 2D covariance and the depth.
struct ImageGradients {
  F mx, my, z;
  F g00, g01, g11;  // d loss = g00 d c00 + 2 g01 d c01 + g11 d c11
};

SB_INLINE ImageGradients from_sums(const LaneSums& sums, const Root& root, const Projected& o, bool antialiased) {
  const F l11 = root.l11, l21 = root.l21, l22 = root.l22;
  // With z = B d and log(alpha) = log(opacity) - |z|^2 / (2 k^2): d/d mean = B^T z / k^2 and
  // d/d covariance = B^T z z^T B / (2 k^4).
  const F su = sums.moments[1], sw = sums.moments[2];
  const F suu = sums.moments[3], suw = sums.moments[4], sww = sums.moments[5];
  constexpr float kInverse = 1.0F / kHalfLog2e;
  ImageGradients g;
  g.z = sums.depth;
  // Plane depth at a pixel falls by the slope as the centre moves.
  g.mx = fnma(sums.slope[0], g.z, set1(kInverse) * l11 * su);
  g.my = fnma(sums.slope[1], g.z, set1(kInverse) * fma(l21, su, l22 * sw));
  const F half = set1(0.5F * kInverse * kInverse);
  g.g00 = half * l11 * l11 * suu;
  g.g01 = half * l11 * fma(l21, suu, l22 * suw);
  g.g11 = half * fma(l21 * l21, suu, fma(set1(2.0F) * l21 * l22, suw, l22 * l22 * sww));
  if (antialiased) {
    // log(opacity) holds log(q) / 2 with q = det_sharp / det; none where q is held at its least.
    const F q = antialias_squared(o);
    const M free = q > set1(kMinAntialias * kMinAntialias);
    const F h = zero_unless(free, set1(0.5F) * sums.moments[0] / (q * o.det));
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
      out.covar[at++] = i == j ? entry : two * entry;  // an off-diagonal entry counts twice
    }
  }
  return r;
}

// Through a pinhole, to the centre and the axes in the camera frame.
SB_INLINE void through_pinhole(const GaussianLanes& g, const CameraLanes& cam, const Projected& o,
                               const ImageGradients& image, bool of_covar, bool camera, F (&gp)[3], F (&ga)[9],
                               LaneGradients& out) {
  const RowGradients r = of_covar ? into_covar(o, image, out) : into_axes(g, o, image, out);
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
    // j x (a - slope a') has the derivative a / z to the focal length where the slope is clamped: j x slope is
    // constant there.
    const F clamped_x = dot3(o.a, r.rows[0]) / cam.fx, clamped_y = dot3(o.a + 3, r.rows[1]) / cam.fy;
    out.intrinsics[0] = fma(image.mx * o.p[0], iz, select(o.slope_free[0], r.jx * iz, clamped_x));
    out.intrinsics[1] = fma(image.my * o.p[1], iz, select(o.slope_free[1], r.jy * iz, clamped_y));
    out.intrinsics[2] = image.mx - held_x / cam.fx;
    out.intrinsics[3] = image.my - held_y / cam.fy;
  }
  gp[0] = fma(image.mx, o.jx, gsx * iz);
  gp[1] = fma(image.my, o.jy, gsy * iz);
  const F along = fma(gjx, o.jx, fma(gjy, o.jy, fma(gsx, o.slope[0], gsy * o.slope[1])));
  gp[2] = fnma(along, iz, image.z);
}

// Through another linearized camera.
template <Projection P>
SB_INLINE void through_affine(const GaussianLanes& g, const CameraLanes& cam, const Projected& o, const Affine& lens,
                              const ImageGradients& image, bool of_covar, F (&gp)[3], F (&ga)[9], LaneGradients& out) {
  const RowGradients r = of_covar ? into_covar(o, image, out) : into_axes(g, o, image, out);
  F gj[2][3];
  for (int c = 0; c < 3; ++c) {
    gj[0][c] = dot3(r.rows[0], o.a + 3 * c);
    gj[1][c] = dot3(r.rows[1], o.a + 3 * c);
    for (int k = 0; k < 3; ++k) {
      ga[3 * c + k] = fma(lens.j[0][c], r.rows[0][k], lens.j[1][c] * r.rows[1][k]);
    }
  }
  pull_back_affine<P>(lens, o.p, cam.fx, cam.fy, image.mx, image.my, image.z, gj, gp);
}

// Applies to a camera whose pixels are the focal lengths times a direction, plus the principal point.
SB_INLINE void into_intrinsics(const CameraLanes& cam, const Projected& o, const ImageGradients& image,
                               LaneGradients& out) {
  const F two = set1(2.0F);
  const F mixed = image.g01 * o.c01;
  out.intrinsics[0] = fma(image.mx, o.mx - cam.cx, two * fma(image.g00, o.s00, mixed)) / cam.fx;
  out.intrinsics[1] = fma(image.my, o.my - cam.cy, two * fma(image.g11, o.s11, mixed)) / cam.fy;
  out.intrinsics[2] = image.mx;
  out.intrinsics[3] = image.my;
}

// Gradient of the 2D mean and covariance into the Gaussian and the camera; into the latter and the quaternion only if
// wanted.
template <Projection P>
void pull_back(const GaussianLanes& g, const CameraLanes& cam, const View& view, const Projected& o,
               const Affine& lens, const ImageGradients& image, bool of_covar, bool camera, bool quat,
               LaneGradients& out) {
  F gp[3], ga[9];
  if constexpr (P == Projection::pinhole) {
    through_pinhole(g, cam, o, image, of_covar, camera, gp, ga, out);
  } else {
    const bool moves = P == Projection::unscented && camera && view.lens.shutter != Shutter::global;
    if constexpr (P == Projection::unscented) {
      pull_back_unscented(g, view, o, image, gp, ga, out.scale, moves ? &out.moved : nullptr);
    } else {
      through_affine<P>(g, cam, o, lens, image, of_covar, gp, ga, out);
    }
    if (camera) {
      into_intrinsics(cam, o, image, out);
    }
    if (moves) {
      const int across = ShutterTime(view).axis;
      out.intrinsics[across] = out.intrinsics[across] + out.moved.focal;
      out.intrinsics[2 + across] = out.intrinsics[2 + across] + out.moved.center;
    }
  }
  out.mean2d[0] = image.mx;
  out.mean2d[1] = image.my;

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
    F r[9];
    pull_back_axes(cam, ga, r);
    pull_back_rotation(o, r, out.quat);
  }
}

void scatter_covars(float* rows, const std::uint32_t* ids, int n, const F (&upper)[6], bool add) {
  const F zero = set1(0.0F);
  const F all[9] = {upper[0], upper[1], upper[2], zero, upper[3], upper[4], zero, zero, upper[5]};
  scatter_lanes<9>(rows, ids, n, all, add);
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
  scatter_inputs(args, ids, n, grads, sums.moments[0]);
  if (args.covars != nullptr) {
    scatter_covars(args.covars, ids, n, grads.covar, args.accumulate);
  }
  if (args.absolute2d != nullptr) {
    const F scale = set1(1.0F / kHalfLog2e);
    const F absolute[2] = {scale * root.l11 * sums.absolute[0], scale * sums.absolute[1]};
    scatter_lanes<2>(args.absolute2d, ids, n, absolute, false);
  }
}

void zero_rows(const ProjectBackwardArgs& args, const BlockRows& rows) {
  if (args.first && !args.accumulate_colors) {
    clear_rows(args.colors, rows, static_cast<std::size_t>(args.forward.channels));
  }
  if (args.last) {
    clear_rows(args.means2d, rows, 2);
    clear_rows(args.absolute2d, rows, 2);
  }
  if (args.last && !args.accumulate) {
    clear_inputs(args, rows);
    clear_rows(args.covars, rows, 9);
  }
}

// A Gaussian's sums of this pass and of those before, where several passes share it; kept for those to come.
SB_INLINE void carry(const ProjectBackwardArgs& args, std::size_t id, float* sums) {
  float* carried = args.carried + id * kSlot;  // moments, then depth, then absolute gradients
  if (!args.first) {
    for (int k = 0; k <= kMoments; ++k) {
      sums[k] += carried[k];
    }
    sums[kAbsolute] += carried[kAbsolute];
    sums[kAbsolute + 1] += carried[kAbsolute + 1];
  }
  std::memcpy(carried, sums, kSlot * sizeof(float));
}

// The sums of W Gaussians, zeros beyond n; colour gradients are written on the way.
SB_INLINE void collect(const ProjectBackwardArgs& args, const ProjectedBlock& block, const std::uint32_t* ids, int n,
                       LaneSums& out) {
  static_assert(kMoments == 6 && kAbsolute == 14);
  alignas(64) float sums[W][kSlot];
  const bool depth = args.depth_in_pass && args.channel_sums > 0;
  for (int i = 0; i < n; ++i) {
    sum_slots(args, block, ids[i], sums[i]);
    if (args.colors != nullptr) {
      write_colors(args, ids[i], sums[i]);
    }
    if (!depth) {
      sums[i][kMoments] = 0.0F;
    }
    if (args.carried != nullptr) {
      carry(args, ids[i], sums[i]);
    }
  }
  for (int i = n; i < W; ++i) {
    std::memset(sums[i], 0, sizeof(sums[i]));
  }
  const auto group = [&](int g, F(&to)[4]) { load_rows<4>([&](int i) { return sums[i] + 4 * g; }, to); };
  F first[4], second[4];
  group(0, first);
  group(1, second);
  for (int k = 0; k < 4; ++k) {
    out.moments[k] = first[k];
  }
  out.moments[4] = second[0];
  out.moments[5] = second[1];
  out.depth = second[2];
  if (args.absolute2d != nullptr) {
    F last[4];
    group(3, last);
    out.absolute[0] = last[2];
    out.absolute[1] = last[3];
  }
  out.slope[0] = out.slope[1] = set1(0.0F);
  if (args.forward.options.plane_depth && args.forward.options.depth != DepthMode::none) {
    F last[4];
    const Record* records = args.forward.records;
    load_rows<4>([&](int i) { return records[ids[i < n ? i : n - 1]].channels + kRecordChannels - 4; }, last);
    out.slope[0] = last[2];
    out.slope[1] = last[3];
  }
}

template <Projection P>
void project_backward_block(const ProjectBackwardArgs& args, std::size_t b) {
  CameraSums camera_sums;
  const bool of_covar = args.forward.covars != nullptr;
  const CameraLanes cam(args.forward.view);
  each_visible(args, b, zero_rows, [&](const std::uint32_t* ids, int n) {
    LaneSums sums;
    collect(args, args.blocks[b], ids, n, sums);
    if (!args.last || !args.geometry) {
      return;
    }
    GaussianLanes g;
    gather_lanes<3>(args.forward.means, ids, n, g.mean);
    from_origin(cam, g.mean);
    if (of_covar) {
      gather_covars(args.forward.covars, ids, n, g.covar);
    } else {
      gather_axes(args.forward, ids, n, g);
    }
    Projected o;
    project_center(g, cam, o);
    Affine lens;
    project_image<P>(g, cam, args.forward.view, set1(args.forward.options.eps2d), of_covar, o, lens);
    const Root root = root_of_inverse(o);
    LaneGradients grads;
    const ImageGradients image = from_sums(sums, root, o, args.forward.options.antialiased);
    pull_back<P>(g, cam, args.forward.view, o, lens, image, of_covar, args.camera != nullptr, args.quats != nullptr,
                 grads);
    write_gradients(args, ids, n, grads, sums, root);
    if (args.camera != nullptr) {
      camera_sums.add(grads.rotation, grads.translation, grads.intrinsics, n);
      if (args.forward.view.lens.shutter != Shutter::global) {
        camera_sums.add_motion(grads.moved.motion, n);
      }
    }
  });
  if (args.camera != nullptr && args.last) {
    camera_sums.write(args.camera + b * kCameraSums);
  }
}

}  // namespace

void project_backward(const ProjectBackwardArgs& args, std::size_t b) {
  switch (projection_of(args.forward.view)) {
    case Projection::pinhole:
      return project_backward_block<Projection::pinhole>(args, b);
    case Projection::ortho:
      return project_backward_block<Projection::ortho>(args, b);
    case Projection::fisheye:
      return project_backward_block<Projection::fisheye>(args, b);
    case Projection::unscented:
      return project_backward_block<Projection::unscented>(args, b);
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
