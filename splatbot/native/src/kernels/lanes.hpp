// SPDX-License-Identifier: Apache-2.0
// Code that the projections share.
#pragma once

#include "project.hpp"
#include "rows.hpp"

namespace splatbot::SPLATBOT_KERNELS {

// Index of the first value that is not finite, or n.
inline std::size_t first_not_finite(const float* values, std::size_t n) {
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

// Rows of one projection block.
struct BlockRows {
  std::size_t begin, end;
};

SB_INLINE BlockRows rows_of_block(std::size_t block, std::size_t count) {
  const std::size_t begin = block * kProjectBlock;
  return {begin, begin + kProjectBlock < count ? begin + kProjectBlock : count};
}

// Begins a block's result with the first input of its Gaussians that is not finite, if there is one.
template <class Args>
bool find_fault(const Args& args, const BlockRows& rows, ProjectedBlock& out) {
  out = ProjectedBlock{};
  const bool harmonics = args.sh_degree >= 0;
  const float* fields[] = {args.means, args.quats, args.scales, args.covars, args.opacities, args.colors};
  const auto columns = static_cast<std::size_t>(harmonics ? 3 * args.coefficients : args.channels);
  const std::size_t widths[] = {3, 4, 3, 9, 1, columns};
  for (int f = 0; f < 6; ++f) {
    if (fields[f] == nullptr) {
      continue;
    }
    const std::size_t n = (rows.end - rows.begin) * widths[f];
    const std::size_t bad = first_not_finite(fields[f] + rows.begin * widths[f], n);
    if (bad < n) {
      out.fault_field = f;
      out.fault_row = rows.begin + bad / widths[f];
      return true;
    }
  }
  return false;
}

// Calls each(first, n) for W rows of a block at a time, fewer at its end.
template <class Each>
SB_INLINE void each_lanes(const BlockRows& rows, Each each) {
  for (std::size_t first = rows.begin; first < rows.end; first += W) {
    const std::size_t left = rows.end - first;
    each(first, left < W ? static_cast<int>(left) : W);
  }
}

// Calls clear(rows) for a block that holds splats out of view, then each(ids, n) for W splats in view at a time. `args`
// are those of a backward pass.
template <class Args, class Clear, class Each>
SB_INLINE void each_visible(const Args& args, std::size_t b, Clear clear, Each each) {
  const ProjectedBlock& block = args.blocks[b];
  const BlockRows rows = rows_of_block(b, args.forward.count);
  if (block.visible < rows.end - rows.begin) {
    clear(args, rows);
  }
  const std::uint32_t* visible = args.forward.visible + rows.begin;
  for (std::uint32_t at = 0; at < block.visible; at += W) {
    each(visible + at, block.visible - at < W ? static_cast<int>(block.visible - at) : W);
  }
}

// n splats with their means, opacities and centres. `keep` marks those between the planes that are not too faint.
struct CenterLanes {
  GaussianLanes g;
  F opacity;
  Projected o;
  M keep;
  std::uint32_t wanted;  // the bits of the n lanes

  SB_INLINE std::uint32_t kept() const { return bits(keep) & wanted; }
};

// Loads n splats from `first` on.
template <class Args>
SB_INLINE void load_centers(const Args& args, const CameraLanes& cam, std::size_t first, int n, CenterLanes& c) {
  F opacities[1];
  load_lanes<3>(args.means, first, n, c.g.mean);
  load_lanes<1>(args.opacities, first, n, opacities);
  from_origin(cam, c.g.mean);
  project_center(c.g, cam, c.o);
  c.opacity = opacities[0];
  const F depth = c.o.p[2];
  c.keep = (depth >= set1(args.options.near_plane)) & (depth <= set1(args.options.far_plane)) &
           (depth > set1(0.0F)) & (c.opacity >= set1(kAlphaMin));
  c.wanted = (1U << n) - 1U;
}

template <class Args>
SB_INLINE void gather_axes(const Args& forward, const std::uint32_t* ids, int n, GaussianLanes& g) {
  gather_lanes<4>(forward.quats, ids, n, g.quat);
  gather_lanes<3>(forward.scales, ids, n, g.scale);
}

// Tiles that a box meets, clamped to the image: x in the low half, y in the high half.
struct TileBox {
  I corner, size;
};

SB_INLINE TileBox tile_box(int columns, int rows, F left, F right, F top, F bottom) {
  const auto tile = [](F at, int pixels, int tiles) {
    const F last = set1(static_cast<float>(tiles - 1));
    return to_int(clamp(floor(at * set1(1.0F / static_cast<float>(pixels))), set1(0.0F), last));
  };
  const I x0 = tile(left, kTileWidth, columns), x1 = tile(right, kTileWidth, columns);
  const I y0 = tile(top, kTileHeight, rows), y1 = tile(bottom, kTileHeight, rows);
  return {x0 | shift_left<16>(y0), (x1 - x0 + set1(1)) | shift_left<16>(y1 - y0 + set1(1))};
}

// Zeros rows of an array of `width` columns; no array, nothing to do.
SB_INLINE void clear_rows(float* array, const BlockRows& rows, std::size_t width) {
  if (array != nullptr) {
    std::memset(array + rows.begin * width, 0, (rows.end - rows.begin) * width * sizeof(float));
  }
}

// Zeros the gradients to the inputs of either kind of splat.
template <class Args>
SB_INLINE void clear_inputs(const Args& args, const BlockRows& rows) {
  clear_rows(args.means, rows, 3);
  clear_rows(args.quats, rows, 4);
  clear_rows(args.scales, rows, 3);
  clear_rows(args.opacities, rows, 1);
}

// Writes the gradients to the inputs of either kind of splat; `grad_log_opacity` is that to the opacity's logarithm.
template <class Args, class Gradients>
SB_INLINE void scatter_inputs(const Args& args, const std::uint32_t* ids, int n, const Gradients& grads,
                              F grad_log_opacity) {
  scatter_lanes<3>(args.means, ids, n, grads.mean, args.accumulate);
  scatter_lanes<4>(args.quats, ids, n, grads.quat, args.accumulate);
  scatter_lanes<3>(args.scales, ids, n, grads.scale, args.accumulate);
  scatter_lanes<2>(args.means2d, ids, n, grads.mean2d, false);
  if (args.opacities != nullptr) {
    F opacity[1];
    gather_lanes<1>(args.forward.opacities, ids, n, opacity);
    const F gradient[1] = {grad_log_opacity / opacity[0]};
    scatter_lanes<1>(args.opacities, ids, n, gradient, args.accumulate);
  }
}

// Gradients of the camera's rotation, translation, intrinsics and motion, lane by lane until the end.
class CameraSums {
 public:
  SB_INLINE void add(const F (&rotation)[9], const F (&translation)[3], const F (&intrinsics)[4], int n) {
    alignas(64) float lanes[kStill][W];
    for (int i = 0; i < 9; ++i) {
      store(lanes[i], rotation[i]);
    }
    for (int i = 0; i < 3; ++i) {
      store(lanes[9 + i], translation[i]);
    }
    for (int i = 0; i < 4; ++i) {
      store(lanes[12 + i], intrinsics[i]);
    }
    for (int k = 0; k < kStill; ++k) {
      for (int i = 0; i < W; ++i) {
        sums_[k][i] += i < n ? static_cast<double>(lanes[k][i]) : 0.0;
      }
    }
  }

  SB_INLINE void add_motion(const F (&motion)[kMotionSums], int n) {
    alignas(64) float lanes[W];
    for (int k = 0; k < kMotionSums; ++k) {
      store(lanes, motion[k]);
      for (int i = 0; i < n; ++i) {
        sums_[kStill + k][i] += static_cast<double>(lanes[i]);
      }
    }
  }

  void write(double* to) const {
    for (int k = 0; k < kCameraSums; ++k) {
      to[k] = 0.0;
      for (int i = 0; i < W; ++i) {
        to[k] += sums_[k][i];
      }
    }
  }

 private:
  static constexpr int kStill = kCameraSums - kMotionSums;
  double sums_[kCameraSums][W] = {};
};

// From d loss / d a, a = camera rotation x Gaussian rotation, to d loss / d Gaussian rotation.
SB_INLINE void pull_back_axes(const CameraLanes& cam, const F* ga, F* r) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      r[3 * i + j] = fma(cam.r[i], ga[j], fma(cam.r[3 + i], ga[3 + j], cam.r[6 + i] * ga[6 + j]));
    }
  }
}

// From d loss / d Gaussian rotation to the gradient of the quaternion.
SB_INLINE void pull_back_rotation(const Projected& o, const F* r, F* quat) {
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
    quat[i] = select(o.quat_zero, zero, fnma(radial, o.unit[i], q[i]) / o.norm);
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
