// SPDX-License-Identifier: Apache-2.0
#include "entry.hpp"
#include "lanes.hpp"
#include "project.hpp"
#include "unscented.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

// Change of depth per pixel over a Gaussian's footprint, if its mass lies in the plane through its centre normal to
// its flattest axis n. The ray of pixel (u, v) meets that plane at z(u, v), and d z/d u is -z^2 n_x / (fx n.p). A
// Gaussian without a flattest axis has no plane, so the slope fades with (least scale / middle scale)^2. It is
// bounded where the plane is seen edge-on: over one footprint, depth varies by at most twice the Gaussian's own.
SB_INLINE void plane_slopes(const GaussianLanes& g, const CameraLanes& cam, const Projected& o, F (&slope)[2]) {
  F s[3];
  for (int k = 0; k < 3; ++k) {
    s[k] = max(g.scale[k], -g.scale[k]);
  }
  const F least = min(s[0], min(s[1], s[2]));
  const F most = max(s[0], max(s[1], s[2]));
  const F middle = max(min(s[0], s[1]), min(max(s[0], s[1]), s[2]));
  const M first = s[0] <= least;
  const M second = and_not(s[1] <= least, first);
  F n[3];
  for (int i = 0; i < 3; ++i) {
    n[i] = select(first, o.a[3 * i], select(second, o.a[3 * i + 1], o.a[3 * i + 2]));
  }
  const F fade = set1(1.0F) - square(least / max(middle, set1(1e-30F)));
  const F along = dot3(n, o.p);
  const F floor_along = set1(1e-6F) * o.p[2];
  const F divisor = select(max(along, -along) > floor_along, along, floor_along);
  const F factor = -fade * square(o.p[2]) / divisor;
  slope[0] = factor * n[0] / cam.fx;
  slope[1] = factor * n[1] / cam.fy;
  F z_axis[3];
  for (int k = 0; k < 3; ++k) {
    z_axis[k] = o.a[6 + k] * g.scale[k];
  }
  const F own = set1(4.0F) * dot3(z_axis, z_axis);
  const F spread = fma(slope[0], fma(slope[0], o.c00, set1(2.0F) * slope[1] * o.c01), slope[1] * slope[1] * o.c11);
  const F shrink = select(spread > own, sqrt(own / max(spread, set1(1e-30F))), set1(1.0F));
  const M known = most > set1(0.0F);
  slope[0] = zero_unless(known, slope[0] * shrink);
  slope[1] = zero_unless(known, slope[1] * shrink);
}

// Outputs of W Gaussians in view.
struct Written {
  F record[8];  // as Record's first eight
  F depth, slope[2];
  I corner, size;  // tiles; x in the low half, y in the high half
};

// Rows of a few floats; a loop of unknown length would cost more than the copy.
SB_INLINE void copy_few(float* to, const float* from, int n) {
  switch (n) {
    case 1:
      return static_cast<void>(std::memcpy(to, from, 1 * sizeof(float)));
    case 3:
      return static_cast<void>(std::memcpy(to, from, 3 * sizeof(float)));
    default:
      for (int i = 0; i < n; ++i) {
        to[i] = from[i];
      }
  }
}

// The channels of all passes, where they are not one depth and three colours.
SB_INLINE void write_channels(const ProjectArgs& args, std::size_t id, float depth, float slope_x, float slope_y) {
  for (int p = 0; p < args.n_passes; ++p) {
    const ChannelPass& pass = args.passes[p];
    float* to = p == 0 ? args.records[id].channels
                       : args.more_channels + (static_cast<std::size_t>(p - 1) * args.count + id) * kRecordChannels;
    const int first = pass.depth_first ? 1 : 0;
    const float* from = args.colors + id * static_cast<std::size_t>(args.channels) + pass.first_color;
    std::memset(to, 0, kRecordChannels * sizeof(float));
    to[0] = depth;
    if (args.sh_degree < 0) {  // else harmonics() writes them
      copy_few(to + first, from, pass.count - first);
    }
    if (pass.depth_first && args.options.plane_depth) {
      to[kRecordChannels - 2] = slope_x;
      to[kRecordChannels - 1] = slope_y;
    }
  }
}

// Columns 4 g .. 4 g + 3 of rows of `stride` floats.
SB_INLINE void store_group(float* rows, std::size_t stride, std::size_t g, const F (&columns)[4]) {
  store_rows<4>([&](int i) { return rows + static_cast<std::size_t>(i) * stride + 4 * g; }, columns);
}

// Channels of Gaussians whose only pass has at most one depth and three colours.
SB_INLINE void few_channels(const ProjectArgs& args, const Written& w, std::size_t first, int n, F (&out)[8]) {
  const F zero = set1(0.0F);
  F color[3] = {zero, zero, zero};
  if (args.sh_degree < 0 && args.channels == 3) {  // else harmonics() writes them, or they are absent
    load_lanes<3>(args.colors, first, n, color);
  }
  const bool depth = args.passes[0].depth_first;
  const bool slopes = depth && args.options.plane_depth;
  const F all[8] = {depth ? w.depth : color[0], depth ? color[0] : color[1], depth ? color[1] : color[2],
                    depth ? color[2] : zero,    zero,                        zero,
                    slopes ? w.slope[0] : zero, slopes ? w.slope[1] : zero};
  for (int c = 0; c < 8; ++c) {
    out[c] = all[c];
  }
}

// Records and placements of the rows from `first` on, for W rows or those in view. The others only get a placement of
// no tiles.
SB_INLINE void write(const ProjectArgs& args, std::size_t first, int n, M keep, std::uint32_t kept, const Written& w,
                     ProjectedBlock& out) {
  static_assert(sizeof(Record) == 16 * sizeof(float) && sizeof(Placement) == 4 * sizeof(float));
  alignas(64) std::uint32_t sizes[W], slots[W];
  const I size = zero_unless(keep, w.size);
  store(sizes, size);
  for (int i = 0; i < W; ++i) {
    slots[i] = static_cast<std::uint32_t>(out.pairs);
    out.pairs += i < n ? std::uint64_t{sizes[i] & 0xffffU} * (sizes[i] >> 16) : 0;
  }
  alignas(64) float tail[W * 16];  // of fewer than W Gaussians: on the way to their rows
  const bool whole = n == W;
  float* records = whole ? &args.records[first].mx : tail;
  store_group(records, 16, 0, {w.record[0], w.record[1], w.record[2], w.record[3]});
  store_group(records, 16, 1, {w.record[4], w.record[5], w.record[6], w.record[7]});
  const bool few = args.n_passes == 1 && (args.sh_degree >= 0 || args.channels == 3 || (args.passes[0].depth_first && args.passes[0].count == 1));
  if (few) {
    F channels[8];
    few_channels(args, w, first, n, channels);
    store_group(records, 16, 2, {channels[0], channels[1], channels[2], channels[3]});
    store_group(records, 16, 3, {channels[4], channels[5], channels[6], channels[7]});
  }
  if (!whole) {
    std::memcpy(&args.records[first], tail, static_cast<std::size_t>(n) * sizeof(Record));
  }
  if (!few) {
    alignas(64) float depth[W], slope_x[W], slope_y[W];
    store(depth, w.depth);
    store(slope_x, w.slope[0]);
    store(slope_y, w.slope[1]);
    for (std::uint32_t left = kept; left != 0; left &= left - 1) {
      const int i = __builtin_ctz(left);
      write_channels(args, first + static_cast<std::size_t>(i), depth[i], slope_x[i], slope_y[i]);
    }
  }
  float slot_bits[W];
  std::memcpy(slot_bits, slots, sizeof(slots));
  float* placements = whole ? reinterpret_cast<float*>(&args.placements[first]) : tail;
  store_group(placements, 4, 0,
              {bit_cast_float(zero_unless(keep, w.corner)), bit_cast_float(size), load(slot_bits), w.depth});
  if (!whole) {
    std::memcpy(&args.placements[first], tail, static_cast<std::size_t>(n) * sizeof(Placement));
  }
}

// Extent of the ellipse in tiles, clamped to the image.
SB_INLINE void cover_tiles(const ProjectArgs& args, F mx, F my, F rx, F ry, Written& w) {
  const TileBox box = tile_box(args.columns, args.rows, mx - rx, mx + rx, my - ry, my + ry);
  w.corner = box.corner;
  w.size = box.size;
}

// Where the box about the ellipse, in whole pixels from its centre, meets the image: gsplat's test of visibility.
SB_INLINE M meets_image(const View& view, F mx, F my, F radius_x, F radius_y) {
  const F zero = set1(0.0F);
  return (mx + radius_x > zero) & (mx - radius_x < set1(static_cast<float>(view.width))) & (my + radius_y > zero) &
         (my - radius_y < set1(static_cast<float>(view.height)));
}

SB_INLINE void load_covars(const float* rows, std::size_t first, int n, F (&out)[6]) {
  F all[9];
  load_lanes<9>(rows, first, n, all);
  const int upper[6] = {0, 1, 2, 4, 5, 8};
  for (int i = 0; i < 6; ++i) {
    out[i] = all[upper[i]];
  }
}

struct DepthRange {
  F least = set1(3.4e38F), most = set1(0.0F);
};

template <Projection P>
void project_lanes(const ProjectArgs& args, const CameraLanes& cam, std::size_t first, int n, std::uint32_t* visible,
                   DepthRange& depths, ProjectedBlock& out) {
  CenterLanes lanes;
  load_centers(args, cam, first, n, lanes);
  auto& [g, opacity, o, keep, wanted] = lanes;
  if (lanes.kept() != 0) {
    const bool of_covar = args.covars != nullptr;
    if (of_covar) {
      load_covars(args.covars, first, n, g.covar);
    } else {
      load_lanes<4>(args.quats, first, n, g.quat);
      load_lanes<3>(args.scales, first, n, g.scale);
    }
    Affine lens;
    project_image<P>(g, cam, args.view, set1(args.options.eps2d), of_covar, o, lens);
    if (args.options.antialiased) {
      opacity = opacity * sqrt(antialias_squared(o));
      keep = keep & (opacity >= set1(kAlphaMin));
    }
    Written w;
    const F lo = log2(max(opacity, set1(kAlphaMin)));
    const F reach = sqrt(max(lo - set1(kLog2AlphaMin), set1(0.0F)));
    const Root root = root_of_inverse(o);
    const F sigmas = reach * set1(1.0F / kRootHalfLog2e);
    const F sx = sqrt(o.c00);
    // A hair more than the reach: rounding must not lose a pixel at the rim.
    const F reach_safe = fma(reach, set1(1.00002F), set1(1e-5F));
    const F rx = reach_safe * set1(1.0F / kRootHalfLog2e) * sx;
    const F ry = reach_safe * set1(1.0F / kRootHalfLog2e) * root.sy;
    const F radius_x = ceil(min(sigmas, set1(kMaxSigmas)) * sx);
    const F radius_y = ceil(min(sigmas, set1(kMaxSigmas)) * root.sy);
    const F clip = set1(args.options.radius_clip);
    const F huge = set1(3e38F);
    cover_tiles(args, o.mx, o.my, rx, ry, w);
    keep = keep & meets_image(args.view, o.mx, o.my, radius_x, radius_y) & (o.det > set1(0.0F)) & (o.det < huge) &
           (o.c00 < huge) & (o.c11 < huge) & (max(radius_x, radius_y) > clip);
    keep = keep & (root.l11 > set1(0.0F)) & (root.l11 < huge) & (root.l22 > set1(0.0F));
    const std::uint32_t kept = lanes.kept();
    const F record[8] = {o.mx, o.my, root.l11, root.l21, root.l22, lo, reach_safe, reach_safe * o.c01 / (sx * root.sy)};
    for (int c = 0; c < 8; ++c) {
      w.record[c] = record[c];
    }
    w.depth = o.p[2];
    w.slope[0] = w.slope[1] = set1(0.0F);
    if (args.options.plane_depth) {
      plane_slopes(g, cam, o, w.slope);
    }
    write(args, first, n, keep, kept, w, out);
    depths.least = min(depths.least, select(keep, w.depth, depths.least));
    depths.most = max(depths.most, select(keep, w.depth, depths.most));
    for (std::uint32_t left = kept; left != 0; left &= left - 1) {
      visible[out.visible++] = static_cast<std::uint32_t>(first) + static_cast<std::uint32_t>(__builtin_ctz(left));
    }
    return;
  }
  std::memset(static_cast<void*>(args.placements + first), 0, static_cast<std::size_t>(n) * sizeof(Placement));
}

template <Projection P>
void project_all(const ProjectArgs& args, const BlockRows& rows, ProjectedBlock& out) {
  const CameraLanes cam(args.view);
  DepthRange depths;
  each_lanes(rows, [&](std::size_t first, int n) {
    project_lanes<P>(args, cam, first, n, args.visible + rows.begin, depths, out);
  });
  float least[W], most[W];
  store(least, depths.least);
  store(most, depths.most);
  for (int i = 1; i < W; ++i) {
    least[0] = least[i] < least[0] ? least[i] : least[0];
    most[0] = most[i] > most[0] ? most[i] : most[0];
  }
  if (out.visible != 0) {
    std::memcpy(&out.least_key, least, sizeof(float));
    std::memcpy(&out.most_key, most, sizeof(float));
  }
}

}  // namespace

void project(const ProjectArgs& args, std::size_t block, ProjectedBlock& out) {
  const BlockRows rows = rows_of_block(block, args.count);
  if (find_fault(args, rows, out)) {
    return;
  }
  switch (projection_of(args.view)) {
    case Projection::pinhole:
      return project_all<Projection::pinhole>(args, rows, out);
    case Projection::ortho:
      return project_all<Projection::ortho>(args, rows, out);
    case Projection::fisheye:
      return project_all<Projection::fisheye>(args, rows, out);
    case Projection::unscented:
      return project_all<Projection::unscented>(args, rows, out);
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
