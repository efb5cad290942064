// SPDX-License-Identifier: Apache-2.0
#include "entry.hpp"
#include "project.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

// Index of the first value that is not finite, or n.
std::size_t first_not_finite(const float* values, std::size_t n) {
  std::uint32_t bad = 0;
  for (std::size_t i = 0; i < n; ++i) {
    std::uint32_t x;
    std::memcpy(&x, values + i, sizeof(x));
    bad |= static_cast<std::uint32_t>((x & 0x7f800000U) == 0x7f800000U);
  }
  if (bad == 0) {
    return n;
  }
  for (std::size_t i = 0; i < n; ++i) {
    std::uint32_t x;
    std::memcpy(&x, values + i, sizeof(x));
    if ((x & 0x7f800000U) == 0x7f800000U) {
      return i;
    }
  }
  return n;
}

bool find_fault(const ProjectArgs& args, std::size_t begin, std::size_t end, ProjectedBlock& out) {
  const bool harmonics = args.sh_degree >= 0;
  const float* fields[] = {args.means, args.quats, args.scales, args.covars, args.opacities, args.colors};
  const auto columns = static_cast<std::size_t>(harmonics ? 3 * args.coefficients : args.channels);
  const std::size_t widths[] = {3, 4, 3, 9, 1, columns};
  for (int f = 0; f < 6; ++f) {
    if (fields[f] == nullptr) {
      continue;
    }
    const std::size_t n = (end - begin) * widths[f];
    const std::size_t bad = first_not_finite(fields[f] + begin * widths[f], n);
    if (bad < n) {
      out.fault_field = f;
      out.fault_row = begin + bad / widths[f];
      return true;
    }
  }
  return false;
}

// Rows [first, first + n) of an (N, width) array, transposed; the last row is repeated to W.
template <int Width>
SB_INLINE void load_lanes(const float* rows, std::size_t first, int n, F (&out)[Width]) {
  alignas(64) float lanes[Width][W];
  for (int i = 0; i < W; ++i) {
    const float* row = rows + (first + static_cast<std::size_t>(i < n ? i : n - 1)) * Width;
    for (int c = 0; c < Width; ++c) {
      lanes[c][i] = row[c];
    }
  }
  for (int c = 0; c < Width; ++c) {
    out[c] = load(lanes[c]);
  }
}

// Change of depth per pixel over a Gaussian's footprint if its matter lies in the plane through its centre whose
// normal n is its flattest axis: the ray of pixel (u, v) meets that plane at z(u, v), and d z/d u is
// -z^2 n_x / (fx n.p). A Gaussian with no flattest axis has no plane, so the slope fades with (least scale / middle scale)^2; it is bounded
// where the plane is seen edge-on: over one footprint, depth varies by no more than twice the Gaussian's own.
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

struct Lanes {
  alignas(64) float mx[W], my[W], l11[W], l21[W], l22[W], lo[W], reach[W], lean[W];
  alignas(64) float z[W], slope_x[W], slope_y[W];
  alignas(64) std::uint32_t corner[W], size[W];  // x in the low half, y in the high half
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

SB_INLINE void write_channels(const ProjectArgs& args, std::size_t id, const Lanes& lanes, int lane) {
  for (int p = 0; p < args.n_passes; ++p) {
    const ChannelPass& pass = args.passes[p];
    float* to = p == 0 ? args.records[id].channels
                       : args.more_channels + (static_cast<std::size_t>(p - 1) * args.count + id) * kRecordChannels;
    const int depth = pass.depth_first ? 1 : 0;
    const float* from = args.colors + id * static_cast<std::size_t>(args.channels) + pass.first_color;
    std::memset(to, 0, kRecordChannels * sizeof(float));
    to[0] = lanes.z[lane];
    if (args.sh_degree < 0) {  // else harmonics() writes them
      copy_few(to + depth, from, pass.count - depth);
    }
    if (pass.depth_first && args.options.plane_depth) {
      to[kRecordChannels - 2] = lanes.slope_x[lane];
      to[kRecordChannels - 1] = lanes.slope_y[lane];
    }
  }
}

SB_INLINE void write_lane(const ProjectArgs& args, std::size_t id, const Lanes& lanes, int lane, ProjectedBlock& out) {
  Record& record = args.records[id];
  record.mx = lanes.mx[lane];
  record.my = lanes.my[lane];
  record.l11 = lanes.l11[lane];
  record.l21 = lanes.l21[lane];
  record.l22 = lanes.l22[lane];
  record.lo = lanes.lo[lane];
  record.reach = lanes.reach[lane];
  record.lean = lanes.lean[lane];
  write_channels(args, id, lanes, lane);
  Placement& place = args.placements[id];
  const std::uint32_t corner = lanes.corner[lane], size = lanes.size[lane];
  place.x0 = static_cast<std::uint16_t>(corner);
  place.y0 = static_cast<std::uint16_t>(corner >> 16);
  place.nx = static_cast<std::uint16_t>(size);
  place.ny = static_cast<std::uint16_t>(size >> 16);
  place.slot = static_cast<std::uint32_t>(out.pairs);
  std::memcpy(&place.depth_bits, &lanes.z[lane], sizeof(float));
  out.pairs += std::uint64_t{size & 0xffffU} * (size >> 16);
}

// Extent of the ellipse in tiles, clamped to the image.
SB_INLINE void cover_tiles(const ProjectArgs& args, F mx, F my, F rx, F ry, Lanes& lanes) {
  const F zero = set1(0.0F);
  const F left = mx - rx, right = mx + rx, top = my - ry, bottom = my + ry;
  const F last_x = set1(static_cast<float>(args.columns - 1));
  const F last_y = set1(static_cast<float>(args.rows - 1));
  const I x0 = to_int(clamp(floor(left * set1(1.0F / kTileWidth)), zero, last_x));
  const I x1 = to_int(clamp(floor(right * set1(1.0F / kTileWidth)), zero, last_x));
  const I y0 = to_int(clamp(floor(top * set1(1.0F / kTileHeight)), zero, last_y));
  const I y1 = to_int(clamp(floor(bottom * set1(1.0F / kTileHeight)), zero, last_y));
  store(lanes.corner, x0 | shift_left<16>(y0));
  store(lanes.size, (x1 - x0 + set1(1)) | shift_left<16>(y1 - y0 + set1(1)));
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

void project_lanes(const ProjectArgs& args, const CameraLanes& cam, std::size_t first, int n, std::uint32_t* visible,
                   ProjectedBlock& out) {
  GaussianLanes g;
  F opacity[1];
  load_lanes<3>(args.means, first, n, g.mean);
  from_origin(cam, g.mean);
  load_lanes<1>(args.opacities, first, n, opacity);
  Projected o;
  project_center(g, cam, o);
  M keep = (o.p[2] >= set1(args.options.near_plane)) & (o.p[2] <= set1(args.options.far_plane)) &
           (o.p[2] > set1(0.0F)) & (opacity[0] >= set1(kAlphaMin));
  const std::uint32_t wanted = (1U << n) - 1U;
  std::uint32_t kept = bits(keep) & wanted;
  if (kept != 0) {
    const bool of_covar = args.covars != nullptr;
    if (of_covar) {
      load_covars(args.covars, first, n, g.covar);
    } else {
      load_lanes<4>(args.quats, first, n, g.quat);
      load_lanes<3>(args.scales, first, n, g.scale);
    }
    project_rest(g, cam, set1(args.options.eps2d), of_covar, o);
    if (args.options.antialiased) {
      opacity[0] = opacity[0] * sqrt(antialias_squared(o));
      keep = keep & (opacity[0] >= set1(kAlphaMin));
    }
    Lanes lanes;
    const F lo = log2(max(opacity[0], set1(kAlphaMin)));
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
    cover_tiles(args, o.mx, o.my, rx, ry, lanes);
    keep = keep & meets_image(args.view, o.mx, o.my, radius_x, radius_y) & (o.det > set1(0.0F)) & (o.det < huge) &
           (o.c00 < huge) & (o.c11 < huge) & (max(radius_x, radius_y) > clip);
    keep = keep & (root.l11 > set1(0.0F)) & (root.l11 < huge) & (root.l22 > set1(0.0F));
    kept = bits(keep) & wanted;
    store(lanes.mx, o.mx);
    store(lanes.my, o.my);
    store(lanes.l11, root.l11);
    store(lanes.l21, root.l21);
    store(lanes.l22, root.l22);
    store(lanes.lo, lo);
    store(lanes.reach, reach_safe);
    store(lanes.lean, reach_safe * o.c01 / (sx * root.sy));
    store(lanes.z, o.p[2]);
    if (args.options.plane_depth) {
      F slope[2];
      plane_slopes(g, cam, o, slope);
      store(lanes.slope_x, slope[0]);
      store(lanes.slope_y, slope[1]);
    }
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

void project(const ProjectArgs& args, std::size_t block, ProjectedBlock& out) {
  const std::size_t begin = block * kProjectBlock;
  const std::size_t end = begin + kProjectBlock < args.count ? begin + kProjectBlock : args.count;
  out = ProjectedBlock{};
  if (find_fault(args, begin, end, out)) {
    return;
  }
  const CameraLanes cam(args.view);
  for (std::size_t first = begin; first < end; first += W) {
    const std::size_t left = end - first;
    project_lanes(args, cam, first, left < W ? static_cast<int>(left) : W, args.visible + begin, out);
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
