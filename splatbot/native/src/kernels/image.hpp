// SPDX-License-Identifier: Apache-2.0
// Between a tile's planes, one a channel, and images whose channels lie side by side.
#pragma once

#include "tile.hpp"

namespace splatbot::SPLATBOT_KERNELS {

SB_INLINE std::size_t line_of(const TileFrame& frame, std::size_t image_width, int y) {
  return static_cast<std::size_t>(frame.y0 + y) * image_width + static_cast<std::size_t>(frame.x0);
}

// A part of a block is kBlock lines of W / kBlock pixels. each(pixel of the image, index in a plane).
template <class Each>
SB_INLINE void each_part(const TileFrame& frame, std::size_t image_width, Each each) {
  for (int y = 0; y < frame.height; y += kBlock) {
    const std::size_t line = line_of(frame, image_width, y);
    for (int x = 0; x < frame.width; x += W / kBlock) {
      each(line + static_cast<std::size_t>(x), static_cast<std::size_t>(pixel_index(x, y)));
    }
  }
}

template <class Each>
SB_INLINE void each_pixel(const TileFrame& frame, std::size_t image_width, Each each) {
  for (int y = 0; y < frame.height; ++y) {
    const std::size_t line = line_of(frame, image_width, y);
    for (int x = 0; x < frame.width; ++x) {
      each(line + static_cast<std::size_t>(x), static_cast<std::size_t>(pixel_index(x, y)));
    }
  }
}

SB_INLINE bool of_whole_blocks(const TileFrame& frame) {
  return frame.width % kBlock == 0 && frame.height % kBlock == 0;
}

// planes[c] to column[c] of an (H, W, channels) image.
inline void copy_out(const TileFrame& frame, std::size_t width, const float* const* planes, const int* column,
                     int count, int channels, float* image) {
  if (count == 1 && channels == 1 && of_whole_blocks(frame)) {
    each_part(frame, width,
              [&](std::size_t pixel, std::size_t i) { store_lines(image + pixel, width, load(planes[0] + i)); });
  } else if (count == kBlock && channels == kBlock && of_whole_blocks(frame)) {
    const float* by_column[kBlock];
    for (int c = 0; c < kBlock; ++c) {
      by_column[column[c]] = planes[c];
    }
    each_part(frame, width, [&](std::size_t pixel, std::size_t i) {
      F lines[kBlock];
      for (int c = 0; c < kBlock; ++c) {
        lines[c] = load(by_column[c] + i);
      }
      transpose_quads(lines);
      for (std::size_t k = 0; k < kBlock; ++k) {
        store(image + (pixel + k * width) * kBlock, lines[k]);
      }
    });
  } else {
    for (int c = 0; c < count; ++c) {
      float* to = image + column[c];
      const auto step = static_cast<std::size_t>(channels);
      each_pixel(frame, width, [&](std::size_t pixel, std::size_t i) { to[pixel * step] = planes[c][i]; });
    }
  }
}

// The inverse operation; pixels outside the image are left unchanged.
inline void copy_in(const TileFrame& frame, std::size_t width, const float* image, int channels, const int* column,
                    int count, float* const* planes) {
  if (count == 1 && channels == 1 && of_whole_blocks(frame)) {
    each_part(frame, width,
              [&](std::size_t pixel, std::size_t i) { store(planes[0] + i, load_lines(image + pixel, width)); });
  } else if (count == kBlock && channels == kBlock && of_whole_blocks(frame)) {
    float* by_column[kBlock];
    for (int c = 0; c < kBlock; ++c) {
      by_column[column[c]] = planes[c];
    }
    each_part(frame, width, [&](std::size_t pixel, std::size_t i) {
      F lines[kBlock];
      for (std::size_t k = 0; k < kBlock; ++k) {
        lines[k] = load(image + (pixel + k * width) * kBlock);
      }
      transpose_quads(lines);
      for (int c = 0; c < kBlock; ++c) {
        store(by_column[c] + i, lines[c]);
      }
    });
  } else {
    for (int c = 0; c < count; ++c) {
      const float* from = image + column[c];
      const auto step = static_cast<std::size_t>(channels);
      each_pixel(frame, width, [&](std::size_t pixel, std::size_t i) { planes[c][i] = from[pixel * step]; });
    }
  }
}

}  // namespace splatbot::SPLATBOT_KERNELS
