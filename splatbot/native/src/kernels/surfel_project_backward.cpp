// SPDX-License-Identifier: Apache-2.0
// Propagates the sums of surfel_blend_backward() to the gradients of the inputs, W surfels at once. The projection is
// computed again: cheaper than keeping it.
#include "entry.hpp"
#include "surfel.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

constexpr int kLaneSums = kSumColor;  // geometry and normals

struct LaneSums {
  alignas(64) float of[kLaneSums][W];
};

struct LaneGradients {
  F mean[3], quat[4], scale[3], mean2d[2];
  F rotation[9], translation[3], intrinsics[4];  // of the camera
};

// Sum of a surfel's slots in the order of its tiles.
SB_INLINE void sum_slots(const SurfelProjectBackwardArgs& args, const ProjectedBlock& block, std::size_t id,
                         float* sums) {
  const Placement& place = args.forward.placements[id];
  const float* slot = args.slots + (block.first_pair + place.slot) * kSurfelSlot;
  const std::size_t pairs = std::size_t{place.nx} * place.ny;
  const int used = args.sum_channels ? kSurfelSlot : kSumNormal;
  for (int i = 0; i < used; i += W) {
    F acc = load(slot + i);
    for (std::size_t p = 1; p < pairs; ++p) {
      acc = acc + load(slot + p * kSurfelSlot + static_cast<std::size_t>(i));
    }
    store(sums + i, acc);
  }
  for (int i = used; i < kSurfelSlot; ++i) {
    sums[i] = 0.0F;
  }
}

// The sums of W surfels, lane by lane; colour gradients are written on the way.
void collect(const SurfelProjectBackwardArgs& args, const ProjectedBlock& block, const std::uint32_t* ids, int n,
             LaneSums& lanes) {
  alignas(64) float sums[kSurfelSlot];
  for (int lane = 0; lane < W; ++lane) {
    if (lane < n) {
      const std::size_t id = ids[lane];
      sum_slots(args, block, id, sums);
      float* to = args.colors == nullptr ? nullptr : args.colors + id * static_cast<std::size_t>(args.forward.channels);
      for (int c = 0; to != nullptr && c < args.forward.channels; ++c) {
        put(to + c, sums[kSumColor + c], args.accumulate_colors);
      }
    }
    for (int k = 0; k < kLaneSums; ++k) {
      lanes.of[k][lane] = lane < n ? sums[k] : 0.0F;
    }
  }
}

// d loss / d (t0, t1) and d loss / d p', z from those of b, kappa and h (see Surfel).
struct DiscGradients {
  F t0[3], t1[3], slope[2], z, scale[2];
};

SB_INLINE DiscGradients pull_back_disc(const Projected& o, const Surfel& s, const CameraLanes& cam,
                                       const LaneSums& sums) {
  const auto sum = [&](int k) { return load(sums.of[k]); };
  const F* a = o.a;
  const F ifx = set1(1.0F) / cam.fx, ify = set1(1.0F) / cam.fy;
  const F px = s.slope[0], py = s.slope[1];
  const F gb[4] = {sum(kSumU), sum(kSumU + 1), sum(kSumV), sum(kSumV + 1)};
  const F hit_depth = sum(kSumHitDepth);
  const F gkappa = fma(hit_depth, o.p[2], sum(kSumD + 2));
  const F k0 = s.flip * o.p[2] / s.scale[0], k1 = s.flip * o.p[2] / s.scale[1];
  const F e0 = gb[0] * k0 * ifx, e1 = gb[1] * k0 * ify, e2 = gb[2] * k1 * ifx, e3 = gb[3] * k1 * ify;
  const F along0 = fma(s.b[0], gb[0], s.b[1] * gb[1]), along1 = fma(s.b[2], gb[2], s.b[3] * gb[3]);
  DiscGradients g;
  g.scale[0] = -(along0 / s.scale[0]);
  g.scale[1] = -(along1 / s.scale[1]);
  g.z = fma(hit_depth, s.kappa, sum(kSumCenterDepth)) + (along0 + along1) / o.p[2];
  F n[3];  // d loss / d (t0 x t1)
  n[0] = s.flip * fma(gkappa, px, sum(kSumD) * ifx);
  n[1] = s.flip * fma(gkappa, py, sum(kSumD + 1) * ify);
  n[2] = s.flip * gkappa;
  g.t0[0] = fms(a[4], n[2], a[7] * n[1]) + e3;
  g.t0[1] = fms(a[7], n[0], a[1] * n[2]) - e2;
  g.t0[2] = fms(a[1], n[1], a[4] * n[0]) + fms(py, e2, px * e3);
  g.t1[0] = fms(n[1], a[6], n[2] * a[3]) - e1;
  g.t1[1] = fms(n[2], a[0], n[0] * a[6]) + e0;
  g.t1[2] = fms(n[0], a[3], n[1] * a[0]) + fms(px, e1, py * e0);
  g.slope[0] = fma(gkappa, s.n[0], fms(a[7], e1, a[6] * e3));
  g.slope[1] = fma(gkappa, s.n[1], fms(a[6], e2, a[7] * e0));
  return g;
}

void pull_back(const GaussianLanes& g, const CameraLanes& cam, const Projected& o, const Surfel& s,
               const LaneSums& sums, LaneGradients& out) {
  const auto sum = [&](int k) { return load(sums.of[k]); };
  const F filter = set1(kFilter);
  const F su = sum(kSumU + 2), sv = sum(kSumV + 2), sd = sum(kSumD + 2);
  out.mean2d[0] = fms(filter, sum(kSumPointX), fma(s.b[0], su, fma(s.b[2], sv, s.hx * sd)));
  out.mean2d[1] = fms(filter, sum(kSumPointY), fma(s.b[1], su, fma(s.b[3], sv, s.hy * sd)));
  const DiscGradients d = pull_back_disc(o, s, cam, sums);
  const F zero = set1(0.0F);
  for (int i = 0; i < 2; ++i) {
    const F signed_scale = select(g.scale[i] < zero, -d.scale[i], d.scale[i]);
    out.scale[i] = zero_unless(s.scale_free[i], signed_scale);
  }
  out.scale[2] = zero;

  const F inverse_z = set1(1.0F) / o.p[2];
  const F gx = fma(out.mean2d[0], cam.fx, d.slope[0]) * inverse_z;
  const F gy = fma(out.mean2d[1], cam.fy, d.slope[1]) * inverse_z;
  const F gp[3] = {gx, gy, fnma(gx, s.slope[0], fnma(gy, s.slope[1], d.z))};
  F ga[9];
  for (int i = 0; i < 3; ++i) {
    ga[3 * i] = d.t0[i];
    ga[3 * i + 1] = d.t1[i];
    ga[3 * i + 2] = zero;
  }
  for (int i = 0; i < 3; ++i) {
    out.mean[i] = fma(cam.r[i], gp[0], fma(cam.r[3 + i], gp[1], cam.r[6 + i] * gp[2]));
    out.translation[i] = gp[i];
    for (int j = 0; j < 3; ++j) {
      const F turned = fma(ga[3 * i], o.rotation[3 * j], ga[3 * i + 1] * o.rotation[3 * j + 1]);
      out.rotation[3 * i + j] = fma(gp[i], g.mean[j], turned);
    }
  }
  // b and h fall with the inverse of the focal lengths.
  const F fall_x = fma(s.b[0], sum(kSumU), fma(s.b[2], sum(kSumV), s.hx * sum(kSumD)));
  const F fall_y = fma(s.b[1], sum(kSumU + 1), fma(s.b[3], sum(kSumV + 1), s.hy * sum(kSumD + 1)));
  out.intrinsics[0] = fms(out.mean2d[0], s.slope[0], fall_x / cam.fx);
  out.intrinsics[1] = fms(out.mean2d[1], s.slope[1], fall_y / cam.fy);
  out.intrinsics[2] = out.mean2d[0];
  out.intrinsics[3] = out.mean2d[1];
  F r[9];
  pull_back_axes(cam, ga, r);
  for (int i = 0; i < 3; ++i) {
    r[3 * i + 2] = fnma(s.flip, sum(kSumNormal + i), r[3 * i + 2]);
  }
  pull_back_rotation(o, r, out.quat);
}

// Replaces values that the forward pass had more precisely, and that must not differ between the passes.
void recall(const SurfelRecord* records, const std::uint32_t* ids, int n, const CameraLanes& cam, Projected& o,
            Surfel& s) {
  enum { kX, kY, kPartX, kPartY, kB, kKappa = kB + 4, kHx, kHy, kZ, kFlip, kValues };
  alignas(64) float lanes[kValues][W];
  for (int i = 0; i < W; ++i) {
    const SurfelRecord& r = records[ids[i < n ? i : n - 1]];
    const float values[kValues] = {r.mx,   r.my,   r.part_x, r.part_y, r.b[0], r.b[1], r.b[2],
                                   r.b[3], r.kappa, r.hx,     r.hy,     r.z,    r.flip};
    for (int k = 0; k < kValues; ++k) {
      lanes[k][i] = values[k];
    }
  }
  for (int k = 0; k < 4; ++k) {
    s.b[k] = load(lanes[kB + k]);
  }
  s.kappa = load(lanes[kKappa]);
  s.hx = load(lanes[kHx]);
  s.hy = load(lanes[kHy]);
  s.slope[0] = (load(lanes[kX]) - cam.cx + load(lanes[kPartX])) / cam.fx;
  s.slope[1] = (load(lanes[kY]) - cam.cy + load(lanes[kPartY])) / cam.fy;
  o.p[2] = load(lanes[kZ]);
  const F flip = load(lanes[kFlip]);
  const F turn = flip * s.flip;
  for (F& n_i : s.n) {
    n_i = n_i * turn;
  }
  s.flip = flip;
}

void zero_rows(const SurfelProjectBackwardArgs& args, const BlockRows& rows) {
  if (!args.accumulate_colors) {
    clear_rows(args.colors, rows, static_cast<std::size_t>(args.forward.channels));
  }
  clear_rows(args.means2d, rows, 2);
  if (!args.accumulate) {
    clear_inputs(args, rows);
  }
}

}  // namespace

void surfel_project_backward(const SurfelProjectBackwardArgs& args, std::size_t b) {
  CameraSums camera_sums;
  const CameraLanes cam(args.forward.view);
  each_visible(args, b, zero_rows, [&](const std::uint32_t* ids, int n) {
    LaneSums sums;
    collect(args, args.blocks[b], ids, n, sums);
    GaussianLanes g;
    gather_lanes<3>(args.forward.means, ids, n, g.mean);
    from_origin(cam, g.mean);
    gather_axes(args.forward, ids, n, g);
    Projected o;
    project_center(g, cam, o);
    Surfel s;
    project_surfel(g, cam, o, s);
    recall(args.forward.records, ids, n, cam, o, s);
    LaneGradients grads;
    pull_back(g, cam, o, s, sums, grads);
    scatter_inputs(args, ids, n, grads, load(sums.of[kSumAlpha]));
    if (args.camera != nullptr) {
      camera_sums.add(grads.rotation, grads.translation, grads.intrinsics, n);
    }
  });
  if (args.camera != nullptr) {
    camera_sums.write(args.camera + b * kCameraSums);
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
