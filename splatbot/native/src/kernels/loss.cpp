// SPDX-License-Identifier: Apache-2.0
// L1 and SSIM of one tile, and their gradient. Rows stream through: products of the two images are blurred along the
// row and enter a ring of eleven rows. The blur across these rows gives the moments of one row of windows. SSIM's
// derivatives by those moments go through a second such ring, because the gradient is their blur.
//
// Both images are relative to the tile's mean. Variances as differences of moments would otherwise lose the
// significant digits in flat regions, where they are small against SSIM's constant 9e-4.
#include "entry.hpp"
#include "simd.hpp"

namespace splatbot::SPLATBOT_KERNELS {

namespace {

constexpr int kMoments4 = 4;      // x, y, xy, x^2 + y^2
constexpr int kDerivatives = 3;  // of SSIM by the mean of x, by that of xy, by that of x^2 + y^2

struct Tile {
  const LossArgs& args;
  std::size_t image;
  int x0, y0, x1, y1;  // its pixels
  int reach;           // how far beyond them windows' centres matter: to the gradient
  float mean;

  int centers() const { return (x1 - x0 + 2 * reach) * args.channels; }        // elements of a row of windows
  int inputs() const { return centers() + 2 * kWindowReach * args.channels; }  // of a row that those see
  int left() const { return x0 - reach - kWindowReach; }                       // first pixel of such a row
};

// Rows of `stride` floats in a tile's scratch.
struct Lines {
  float* memory;
  int stride;

  float* line(int i) const { return memory + static_cast<std::ptrdiff_t>(i) * stride; }
  float* x() const { return line(0); }
  float* y() const { return line(1); }
  float* product(int i) const { return line(2 + i); }  // kMoments4
  float* derivative(int i) const { return line(6 + i); }
  float* center() const { return line(9); }  // 1 where a window's centre counts
  float* owned() const { return line(10); }  // 1 where it is this tile's own
  float* out() const { return line(11); }
  float* moment(int row, int i) const { return line(12 + kMoments4 * row + i); }
  float* blurred(int row, int i) const { return line(12 + kMoments4 * kWindow + kDerivatives * row + i); }
};

// A row of both images from pixel `left` on, 0 outside the image; where the mask is 0, the target twice.
void fetch(const Tile& t, int row, int left, int elements, float* x, float* y) {
  const LossArgs& a = t.args;
  std::memset(x, 0, sizeof(float) * static_cast<std::size_t>(elements));
  std::memset(y, 0, sizeof(float) * static_cast<std::size_t>(elements));
  if (row < 0 || row >= a.height) {
    return;
  }
  const int right = left + elements / a.channels;
  const int from = left < 0 ? 0 : left, to = right > a.width ? a.width : right;
  const std::size_t start = (t.image * static_cast<std::size_t>(a.height) + static_cast<std::size_t>(row)) *
                                static_cast<std::size_t>(a.width) + static_cast<std::size_t>(from);
  const std::size_t offset = static_cast<std::size_t>((from - left) * a.channels);
  const std::size_t channels = static_cast<std::size_t>(a.channels), pixels = static_cast<std::size_t>(to - from);
  std::memcpy(x + offset, a.rendered + start * channels, sizeof(float) * pixels * channels);
  std::memcpy(y + offset, a.target + start * channels, sizeof(float) * pixels * channels);
  for (std::size_t i = 0; a.mask != nullptr && i < pixels; ++i) {
    if (a.mask[start + i] == 0) {
      std::memcpy(x + offset + i * channels, y + offset + i * channels, sizeof(float) * channels);
    }
  }
}

// 1 at the elements of a row of windows whose centre counts and, of those, at the tile's own; `masked` looks at the mask.
void mark(const Tile& t, int row, const Lines& lines) {
  const LossArgs& a = t.args;
  const std::uint8_t* mask = a.mask == nullptr ? nullptr
                                               : a.mask + (t.image * static_cast<std::size_t>(a.height) +
                                                           static_cast<std::size_t>(row)) * static_cast<std::size_t>(a.width);
  const int pixels = t.centers() / a.channels;
  for (int i = 0; i < pixels; ++i) {
    const int column = t.x0 - t.reach + i;
    const bool counts = column >= a.margin && column < a.width - a.margin && (mask == nullptr || mask[column] != 0);
    const bool own = counts && column >= t.x0 && column < t.x1;
    for (int c = 0; c < a.channels; ++c) {
      lines.center()[i * a.channels + c] = counts ? 1.0F : 0.0F;
      lines.owned()[i * a.channels + c] = own ? 1.0F : 0.0F;
    }
  }
  for (int i = pixels * a.channels; i < pixels * a.channels + W; ++i) {
    lines.center()[i] = lines.owned()[i] = 0.0F;
  }
}

// Mean of the target's rows that are in the tile, of every fourth.
float tile_mean(const Tile& t, const Lines& lines) {
  const int elements = (t.x1 - t.x0) * t.args.channels;
  double sum = 0.0;
  int rows = 0;
  for (int row = t.y0; row < t.y1; row += 4, ++rows) {
    fetch(t, row, t.x0, elements, lines.x(), lines.y());
    std::memset(lines.y() + elements, 0, sizeof(float) * W);
    F s = set1(0.0F);
    for (int i = 0; i < elements; i += W) {
      s = s + load(lines.y() + i);
    }
    sum += static_cast<double>(total(s));
  }
  return static_cast<float>(sum / (static_cast<double>(rows) * elements));
}

// The window's weights in registers: it is symmetric.
struct Window {
  F of[kWindowReach + 1];

  explicit Window(const float* weights) {
    for (int k = 0; k <= kWindowReach; ++k) {
      of[k] = set1(weights[k]);
    }
  }

  SB_INLINE F at(int k) const { return of[k <= kWindowReach ? k : kWindow - 1 - k]; }
};

// out[i] = sum of window[k] in[i + k step], over a row.
SB_INLINE void blur_along(const Window& window, int step, int n, const float* in, float* out) {
  for (int i = 0; i < n; i += W) {
    F s = load(in + i) * window.at(0);
#pragma GCC unroll 10
    for (int k = 1; k < kWindow; ++k) {
      s = fma(load(in + i + k * step), window.at(k), s);
    }
    store(out + i, s);
  }
}

// The same over the rows of a ring, the oldest first.
SB_INLINE F blur_across(const Window& window, const float* const* rows, int i) {
  F s = load(rows[0] + i) * window.at(0);
#pragma GCC unroll 10
  for (int k = 1; k < kWindow; ++k) {
    s = fma(load(rows[k] + i), window.at(k), s);
  }
  return s;
}

void multiply_row(const Tile& t, int row, const Lines& lines) {
  fetch(t, row, t.left(), t.inputs(), lines.x(), lines.y());
  const F mean = set1(t.mean);
  for (int i = 0; i < t.inputs(); i += W) {
    const F x = load(lines.x() + i) - mean, y = load(lines.y() + i) - mean;
    store(lines.product(0) + i, x);
    store(lines.product(1) + i, y);
    store(lines.product(2) + i, x * y);
    store(lines.product(3) + i, fma(x, x, y * y));
  }
}

struct RingRows {
  const float* of[kMoments4][kWindow];
};

// SSIM of one row of windows into `sum`, where they are the tile's own, and its derivatives by their moments.
template <bool kGradient>
void windows_row(const Tile& t, const RingRows& ring, const Lines& lines, double* sum) {
  const F mean = set1(t.mean), two = set1(2.0F), zero = set1(0.0F);
  const F c1 = set1(kSsimC1), c2 = set1(kSsimC2);
  const Window window(t.args.window);
  F owned_sum = zero;
  for (int i = 0; i < t.centers(); i += W) {
    const F m1 = blur_across(window, ring.of[0], i), m2 = blur_across(window, ring.of[1], i);
    const F e12 = blur_across(window, ring.of[2], i), squares = blur_across(window, ring.of[3], i);
    const F mu1 = m1 + mean, mu2 = m2 + mean;
    const F a1 = fma(two * mu1, mu2, c1);
    const F a2 = fma(two, fnma(m1, m2, e12), c2);
    const F b1 = fma(mu1, mu1, fma(mu2, mu2, c1));
    const F b2 = max(fnma(m1, m1, fnma(m2, m2, squares)), zero) + c2;  // rounding must not make a variance negative
    const F inverse = set1(1.0F) / (b1 * b2);
    const F ssim = a1 * a2 * inverse;
    owned_sum = owned_sum + zero_unless(load(lines.owned() + i) > zero, ssim);
    if constexpr (kGradient) {
      const M counts = load(lines.center() + i) > zero;
      const F by_xy = two * a1 * inverse;
      const F by_mean = two * inverse * (fnma(m2, a1, mu2 * a2) - ssim * fnma(m1, b1, mu1 * b2));
      store(lines.derivative(0) + i, zero_unless(counts, by_mean));
      store(lines.derivative(1) + i, zero_unless(counts, by_xy));
      store(lines.derivative(2) + i, zero_unless(counts, -(ssim * b1 * inverse)));
    }
  }
  *sum += static_cast<double>(total(owned_sum));
}

// |x - y| of a row of the tile and, into `out` unless null, the gradient of the whole loss.
void pixels_row(const Tile& t, int row, const RingRows* ring, const Lines& lines, LossSums& sums) {
  const LossArgs& a = t.args;
  const int elements = (t.x1 - t.x0) * a.channels;
  fetch(t, row, t.x0, elements, lines.x(), lines.y());
  std::memset(lines.x() + elements, 0, sizeof(float) * W);
  std::memset(lines.y() + elements, 0, sizeof(float) * W);
  const F mean = set1(t.mean), zero = set1(0.0F), two = set1(2.0F);
  const F l1 = set1(a.l1_scale), scale = set1(a.ssim_scale);
  const Window window(a.window);
  F sum = zero;
  for (int i = 0; i < elements; i += W) {
    const F x = load(lines.x() + i), y = load(lines.y() + i);
    const F difference = x - y;
    sum = sum + max(difference, -difference);
    if (ring != nullptr) {
      const F by_mean = blur_across(window, ring->of[0], i), by_xy = blur_across(window, ring->of[1], i);
      const F by_squares = blur_across(window, ring->of[2], i);
      const F ssim = fma(y - mean, by_xy, fma(two * (x - mean), by_squares, by_mean));
      const F sign = zero_unless(difference > zero, l1) - zero_unless(difference < zero, l1);
      store(lines.out() + i, fma(scale, ssim, sign));
    }
  }
  sums.l1 += static_cast<double>(total(sum));
}

void write_gradient(const Tile& t, int row, const float* values) {
  const LossArgs& a = t.args;
  const std::size_t channels = static_cast<std::size_t>(a.channels), pixels = static_cast<std::size_t>(t.x1 - t.x0);
  const std::size_t start = (t.image * static_cast<std::size_t>(a.height) + static_cast<std::size_t>(row)) *
                                static_cast<std::size_t>(a.width) + static_cast<std::size_t>(t.x0);
  std::memcpy(a.gradient + start * channels, values, sizeof(float) * pixels * channels);
  for (std::size_t i = 0; a.mask != nullptr && i < pixels; ++i) {
    if (a.mask[start + i] == 0) {
      std::memset(a.gradient + (start + i) * channels, 0, sizeof(float) * channels);
    }
  }
}

// Rows of a ring whose newest row has the number `newest`.
template <int kCount, class Line>
RingRows ring_rows(int newest, const Line& line) {
  RingRows rows{};
  for (int i = 0; i < kCount; ++i) {
    for (int k = 0; k < kWindow; ++k) {
      rows.of[i][k] = line((newest + 1 + k) % kWindow, i);
    }
  }
  return rows;
}

// Processes a row of windows at image row `row`, whose moments the ring holds. Its derivatives are blurred along the
// row into the other ring.
template <bool kGradient>
void center_row(const Tile& t, int row, int newest, int number, const Lines& lines, LossSums& sums) {
  const LossArgs& a = t.args;
  const bool counts = row >= a.margin && row < a.height - a.margin;
  if (counts) {
    if (a.mask != nullptr) {
      mark(t, row, lines);
    }
    const RingRows moments =
        ring_rows<kMoments4>(newest, [&](int r, int i) { return static_cast<const float*>(lines.moment(r, i)); });
    double beyond = 0.0;  // rows that another tile sums
    windows_row<kGradient>(t, moments, lines, row >= t.y0 && row < t.y1 ? &sums.ssim : &beyond);
  }
  if constexpr (kGradient) {
    const Window window(a.window);
    for (int i = 0; i < kDerivatives; ++i) {
      if (counts) {
        const int elements = (t.x1 - t.x0) * a.channels;
        blur_along(window, a.channels, elements, lines.derivative(i), lines.blurred(number % kWindow, i));
      } else {
        std::memset(lines.blurred(number % kWindow, i), 0, sizeof(float) * static_cast<std::size_t>(lines.stride));
      }
    }
  }
}

template <bool kGradient>
void run(const Tile& t, const Lines& lines, LossSums& sums) {
  const LossArgs& a = t.args;
  mark(t, t.y0, lines);
  const int first = t.y0 - t.reach - kWindowReach;
  for (int row = first; row < t.y1 + t.reach + kWindowReach; ++row) {
    const int newest = row - first;
    multiply_row(t, row, lines);
    const Window window(a.window);
    for (int i = 0; i < kMoments4; ++i) {
      blur_along(window, a.channels, t.centers(), lines.product(i), lines.moment(newest % kWindow, i));
    }
    const int number = newest - (kWindow - 1);  // of the row of windows that is now complete
    if (number < 0) {
      continue;
    }
    center_row<kGradient>(t, row - kWindowReach, newest, number, lines, sums);
    const int done = row - kWindowReach - t.reach;  // the row of pixels that is now complete
    if (kGradient && number >= kWindow - 1) {
      const RingRows derivatives =
          ring_rows<kDerivatives>(number, [&](int r, int i) { return static_cast<const float*>(lines.blurred(r, i)); });
      pixels_row(t, done, &derivatives, lines, sums);
      write_gradient(t, done, lines.out());
    } else if (!kGradient) {
      pixels_row(t, done, nullptr, lines, sums);
    }
  }
}

}  // namespace

void loss(const LossArgs& args, std::size_t tile, float* scratch, LossSums& sums) {
  const std::size_t per_image = static_cast<std::size_t>(args.columns) * static_cast<std::size_t>(args.rows);
  const int place = static_cast<int>(tile % per_image);
  Tile t{args, tile / per_image, place % args.columns * args.tile_width, place / args.columns * args.tile_height,
         0,    0,                args.gradient != nullptr ? kWindowReach : 0, 0.0F};
  t.x1 = t.x0 + args.tile_width < args.width ? t.x0 + args.tile_width : args.width;
  t.y1 = t.y0 + args.tile_height < args.height ? t.y0 + args.tile_height : args.height;
  const Lines lines{scratch, args.stride};
  sums = {0.0, 0.0};
  t.mean = tile_mean(t, lines);
  if (args.gradient != nullptr) {
    run<true>(t, lines, sums);
  } else {
    run<false>(t, lines, sums);
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
