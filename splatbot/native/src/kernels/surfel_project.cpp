// SPDX-License-Identifier: Apache-2.0
#include "entry.hpp"
#include "surfel.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

// Inputs of a cover as the blend will use them.
SB_INLINE void recall(const PreciseLanes& precise, Projected& o, Surfel& s) {
  o.p[2] = load(precise.z);
  for (int i = 0; i < 2; ++i) {
    s.slope[i] = load(precise.slope[i]);
  }
  s.kappa = load(precise.kappa);
  s.mx = load(precise.whole[0]) + load(precise.part[0]);
  s.my = load(precise.whole[1]) + load(precise.part[1]);
}

// The cover of a surfel on the image: an ellipse, the low-pass filter's circle around its centre, and a box of both.
struct Cover {
  M bounded;  // the ellipse exists
  F ex, ey, l11, l21, l22, lean;
  F circle;
  F left, right, top, bottom;
  F radius_x, radius_y;
};

// The image of the disc |(u, v)| <= c. It is an ellipse if the disc stays in front of the camera's plane. With rows A
// = J (s0 t0, s1 t1) of its linear image and b = (s0 t0z, s1 t1z) / z, that is w = 1 - c^2 |b|^2 > 0. The centre is m
// - c^2 A b / w, the "covariance" c^2 / w^2 (w A A^T + c^2 A b b^T A^T). Its determinant is c^4 det(A)^2 / w^3: all
// are sums of positive terms. They are rounded up: rounding must not lose a pixel at the rim.
SB_INLINE Cover cover(const Projected& o, const Surfel& s, const CameraLanes& cam, F reach2) {
  constexpr float kMargin = 1e-3F;     // [px^2]
  constexpr float kInflate = 1.0005F;
  constexpr float kLeastW = 0.02F;     // nearer to the camera's plane, a box of the whole image is good enough
  constexpr float kLargest = 1e15F;    // [px]
  const F* a = o.a;
  const F inverse_z = set1(1.0F) / o.p[2];
  const F k0 = s.scale[0] * inverse_z, k1 = s.scale[1] * inverse_z;
  const F ax0 = cam.fx * k0 * fnma(s.slope[0], a[6], a[0]), ax1 = cam.fx * k1 * fnma(s.slope[0], a[7], a[1]);
  const F ay0 = cam.fy * k0 * fnma(s.slope[1], a[6], a[3]), ay1 = cam.fy * k1 * fnma(s.slope[1], a[7], a[4]);
  const F b0 = k0 * a[6], b1 = k1 * a[7];
  const F w = fnma(reach2, fma(b0, b0, b1 * b1), set1(1.0F));
  const F xb = fma(ax0, b0, ax1 * b1), yb = fma(ay0, b0, ay1 * b1);
  const F f = reach2 / w;
  const F g = f / w;
  const F inflate = set1(kInflate), margin = set1(kMargin);
  const F c00 = inflate * g * fma(reach2, xb * xb, w * fma(ax0, ax0, ax1 * ax1));
  const F c11 = inflate * g * fma(reach2, yb * yb, w * fma(ay0, ay0, ay1 * ay1));
  const F c01 = inflate * g * fma(reach2, xb * yb, w * fma(ax0, ay0, ax1 * ay1));
  const F area = cam.fx * cam.fy * k0 * k1 * s.kappa * inflate;
  const F det = fma(f * f / w, area * area, margin * (c00 + c11 + margin));
  const F s00 = c00 + margin, s11 = c11 + margin;
  const F sx = sqrt(s00), sy = sqrt(s11);
  Cover c;
  c.bounded = (w > set1(kLeastW)) & (sx < set1(kLargest)) & (sy < set1(kLargest));
  const F off_x = fnma(f, xb, set1(0.0F)), off_y = fnma(f, yb, set1(0.0F));
  c.ex = s.mx + off_x;
  c.ey = s.my + off_y;
  c.l22 = set1(1.0F) / sy;
  c.l11 = zero_unless(c.bounded, sy / sqrt(det));
  c.l21 = -(c.l11 * c01 * c.l22 * c.l22);
  c.lean = c01 / (sx * sy);
  const F reach = sqrt(reach2);
  c.circle = fma(reach, set1(0.70712F), set1(0.01F));
  const F box_x = sx + set1(0.01F), box_y = sy + set1(0.01F);
  const F huge = set1(1e30F);
  c.left = select(c.bounded, min(c.ex - box_x, s.mx - c.circle), -huge);
  c.right = select(c.bounded, max(c.ex + box_x, s.mx + c.circle), huge);
  c.top = select(c.bounded, min(c.ey - box_y, s.my - c.circle), -huge);
  c.bottom = select(c.bounded, max(c.ey + box_y, s.my + c.circle), huge);
  c.radius_x = select(c.bounded, max(c.right - s.mx, s.mx - c.left), huge);
  c.radius_y = select(c.bounded, max(c.bottom - s.my, s.my - c.top), huge);
  // An ellipse that holds the circle makes it redundant; sqrt(det / trace) is at most its smaller half axis.
  const F off = max(off_x, -off_x) + max(off_y, -off_y);
  const M holds = c.bounded & (sqrt(det / (s00 + s11)) > c.circle + off);
  c.circle = select(holds, set1(0.0F), c.circle);
  return c;
}

struct Lanes {
  alignas(64) float lo[W], circle[W];
  alignas(64) float ex[W], ey[W], l11[W], l21[W], l22[W], lean[W], rotated[3][W];
  PreciseLanes precise;
  alignas(64) std::uint32_t corner[W], size[W];  // x in the low half, y in the high half
};

// Tiles that the box meets, clamped to the image; a mask of lanes that reach it.
SB_INLINE M cover_tiles(const SurfelProjectArgs& args, const Cover& c, Lanes& lanes) {
  const F zero = set1(0.0F);
  const TileBox box = tile_box(args.columns, args.rows, c.left, c.right, c.top, c.bottom);
  store(lanes.corner, box.corner);
  store(lanes.size, box.size);
  return (c.right > zero) & (c.left < set1(static_cast<float>(args.view.width))) & (c.bottom > zero) &
         (c.top < set1(static_cast<float>(args.view.height)));
}

void store_lanes(const Projected& o, const Cover& c, F lo, Lanes& lanes) {
  store(lanes.lo, lo);
  store(lanes.circle, c.circle);
  store(lanes.ex, c.ex);
  store(lanes.ey, c.ey);
  store(lanes.l11, c.l11);
  store(lanes.l21, c.l21);
  store(lanes.l22, c.l22);
  store(lanes.lean, c.lean);
  for (int i = 0; i < 3; ++i) {
    store(lanes.rotated[i], o.rotation[3 * i + 2]);
  }
}

SB_INLINE void write_lane(const SurfelProjectArgs& args, std::size_t id, const Lanes& lanes, int lane,
                          ProjectedBlock& out) {
  SurfelRecord& r = args.records[id];
  const PreciseLanes& precise = lanes.precise;
  r.mx = precise.whole[0][lane];
  r.my = precise.whole[1][lane];
  r.part_x = precise.part[0][lane];
  r.part_y = precise.part[1][lane];
  for (int i = 0; i < 4; ++i) {
    r.b[i] = precise.b[i][lane];
  }
  r.kappa = precise.kappa[lane];
  r.hx = precise.h[0][lane];
  r.hy = precise.h[1][lane];
  r.flip = precise.flip[lane];
  r.z = precise.z[lane];
  r.lo = lanes.lo[lane];
  r.circle = lanes.circle[lane];
  r.ex = lanes.ex[lane];
  r.ey = lanes.ey[lane];
  r.l11 = lanes.l11[lane];
  r.l21 = lanes.l21[lane];
  r.l22 = lanes.l22[lane];
  r.lean = lanes.lean[lane];
  for (int i = 0; i < 3; ++i) {
    r.normal[i] = -r.flip * lanes.rotated[i][lane];
  }
  const float* colors = args.colors + id * static_cast<std::size_t>(args.channels);
  const int given = args.sh_degree < 0 ? args.channels : 0;  // else harmonics() writes them
  for (int c = 0; c < kMaxSurfelChannels; ++c) {
    r.channels[c] = c < given ? colors[c] : 0.0F;
  }
  Placement& place = args.placements[id];
  const std::uint32_t corner = lanes.corner[lane], size = lanes.size[lane];
  place.x0 = static_cast<std::uint16_t>(corner);
  place.y0 = static_cast<std::uint16_t>(corner >> 16);
  place.nx = static_cast<std::uint16_t>(size);
  place.ny = static_cast<std::uint16_t>(size >> 16);
  place.slot = static_cast<std::uint32_t>(out.pairs);
  std::memcpy(&place.depth_bits, &r.z, sizeof(float));
  out.least_key = place.depth_bits < out.least_key ? place.depth_bits : out.least_key;
  out.most_key = place.depth_bits > out.most_key ? place.depth_bits : out.most_key;
  out.pairs += std::uint64_t{size & 0xffffU} * (size >> 16);
}

void project_lanes(const SurfelProjectArgs& args, const CameraLanes& cam, std::size_t first, int n,
                   std::uint32_t* visible, ProjectedBlock& out) {
  CenterLanes center;
  load_centers(args, cam, first, n, center);
  auto& [g, opacity, o, keep, wanted] = center;
  std::uint32_t kept = center.kept();
  if (kept != 0) {
    load_lanes<4>(args.quats, first, n, g.quat);
    load_lanes<3>(args.scales, first, n, g.scale);
    Surfel s;
    project_surfel(g, cam, o, s);
    const F lo = log2(max(opacity, set1(kAlphaMin)));
    constexpr float kTwoLn2 = 1.3862944F;
    const F reach2 = set1(kTwoLn2) * max(lo - set1(kLog2AlphaMin), set1(0.0F));
    Lanes lanes;
    F means[3];
    load_lanes<3>(args.means, first, n, means);
    project_precisely(means, g, args.view, lanes.precise);
    recall(lanes.precise, o, s);
    const Cover c = cover(o, s, cam, reach2);
    const F huge = set1(1e30F);
    keep = keep & cover_tiles(args, c, lanes) & (s.mx > -huge) & (s.mx < huge) & (s.my > -huge) & (s.my < huge) &
           (max(c.radius_x, c.radius_y) > set1(args.options.radius_clip));
    kept = center.kept();
    store_lanes(o, c, lo, lanes);
    for (std::uint32_t left = kept; left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      const std::size_t id = first + static_cast<std::size_t>(lane);
      write_lane(args, id, lanes, lane, out);
      visible[out.visible++] = static_cast<std::uint32_t>(id);
    }
  }
  for (std::uint32_t left = wanted & ~kept; left != 0; left &= left - 1) {
    args.placements[first + static_cast<std::size_t>(__builtin_ctz(left))] = Placement{};
  }
}

}  // namespace

void surfel_project(const SurfelProjectArgs& args, std::size_t block, ProjectedBlock& out) {
  const BlockRows rows = rows_of_block(block, args.count);
  if (find_fault(args, rows, out)) {
    return;
  }
  const CameraLanes cam(args.view);
  each_lanes(rows, [&](std::size_t first, int n) {
    project_lanes(args, cam, first, n, args.visible + rows.begin, out);
  });
}

}  // namespace splatbot::SPLATBOT_KERNELS
