// SPDX-License-Identifier: Apache-2.0
#include "solid_covers.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "solid_blocks.hpp"

namespace splatbot {

namespace {

using Matrix = std::array<std::array<double, 3>, 3>;

constexpr double kRidge = 1e-9;  // of the trace: keeps the root of a needle's covariance real
constexpr double kRoom = 1e-5;   // for float64's rounding of all this, next to kRidge

// Lower triangle L with L L' = M.
Matrix root_of(const Matrix& M) {
  Matrix L{};
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j <= i; ++j) {
      double sum = M[i][j];
      for (std::size_t k = 0; k < j; ++k) {
        sum -= L[i][k] * L[j][k];
      }
      L[i][j] = i == j ? std::sqrt(sum) : sum / L[j][j];
    }
  }
  return L;
}

Matrix inverse_of(const Matrix& L) {
  Matrix A{};
  for (std::size_t j = 0; j < 3; ++j) {
    A[j][j] = 1.0 / L[j][j];
    for (std::size_t i = j + 1; i < 3; ++i) {
      double sum = 0.0;
      for (std::size_t k = j; k < i; ++k) {
        sum -= L[i][k] * A[k][j];
      }
      A[i][j] = sum / L[i][i];
    }
  }
  return A;
}

Matrix with_its_transpose(const Matrix& B, double scale) {
  Matrix G{};
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      for (std::size_t k = 0; k < 3; ++k) {
        G[i][j] += scale * B[i][k] * B[j][k];
      }
    }
  }
  return G;
}

double sum_of_squares(const Matrix& B) {
  double sum = 0.0;
  for (const auto& row : B) {
    for (const double x : row) {
      sum += x * x;
    }
  }
  return sum;
}

// At least the largest eigenvalue of B B', and at most 1.08 times that: the eighth root of the norm of its eighth power.
double largest_eigenvalue(const Matrix& B) {
  const double trace = sum_of_squares(B);
  Matrix G = with_its_transpose(B, trace > 0.0 ? 1.0 / trace : 0.0);
  for (int i = 0; i < 3; ++i) {
    G = with_its_transpose(G, 1.0);
  }
  return trace * std::sqrt(std::sqrt(std::sqrt(std::sqrt(sum_of_squares(G)))));
}

double length(const double* x) { return std::sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]); }

double length_under(const Matrix& A, const double* x) {
  double y[3];
  for (std::size_t i = 0; i < 3; ++i) {
    y[i] = A[i][0] * x[0] + A[i][1] * x[1] + A[i][2] * x[2];
  }
  return length(y);
}

Cover cover_of(const SolidLeaf& leaf, int lane) {
  Cover c{};
  float R[9];
  axes_of(leaf, lane, R);
  double least = 1e30;
  for (std::size_t i = 0; i < 3; ++i) {
    c.center[i] = static_cast<double>(leaf.mean[i][lane]);
    for (std::size_t j = 0; j < 3; ++j) {
      c.axes[i][j] = static_cast<double>(R[3 * i + j]) * static_cast<double>(leaf.axes[j][lane]);
    }
    least = std::min(least, static_cast<double>(leaf.axes[i][lane]));
  }
  c.thin = 1.0 / least;
  return c;
}

// The least multiple of the mean covariance that covers all: its root as `axes`, and the inverse of that.
Matrix whitening_of(std::span<const Cover> parts, Matrix& axes) {
  Matrix M{};
  for (const Cover& part : parts) {
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t j = 0; j < 3; ++j) {
        for (std::size_t k = 0; k < 3; ++k) {
          M[i][j] += part.axes[i][k] * part.axes[j][k] / static_cast<double>(parts.size());
        }
      }
    }
  }
  const double ridge = kRidge * (M[0][0] + M[1][1] + M[2][2]);
  for (std::size_t i = 0; i < 3; ++i) {
    M[i][i] += ridge;
  }
  axes = root_of(M);
  Matrix A = inverse_of(axes);
  double largest = 0.0;
  for (const Cover& part : parts) {
    Matrix B{};
    for (std::size_t i = 0; i < 3; ++i) {
      for (std::size_t j = 0; j < 3; ++j) {
        for (std::size_t k = 0; k <= i; ++k) {
          B[i][j] += A[i][k] * part.axes[k][j];
        }
      }
    }
    largest = std::max(largest, largest_eigenvalue(B));
  }
  const double grown = std::sqrt(largest) * (1.0 + kRoom);
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t j = 0; j < 3; ++j) {
      axes[i][j] *= grown;
      A[i][j] /= grown;
    }
  }
  return A;
}

struct Whitened {
  Cover cover;
  Matrix A;
};

Whitened merged(std::span<const Cover> parts) {
  Whitened all{};
  Matrix axes;
  all.A = whitening_of(parts, axes);
  for (std::size_t k = 0; k < 3; ++k) {
    std::copy(axes[k].begin(), axes[k].end(), all.cover.axes[k]);
    const auto [low, high] = std::minmax_element(parts.begin(), parts.end(), [k](const Cover& a, const Cover& b) {
      return a.center[k] < b.center[k];
    });
    all.cover.center[k] = static_cast<double>(static_cast<float>(0.5 * (low->center[k] + high->center[k])));
  }
  for (const Cover& part : parts) {
    double apart[3];
    for (std::size_t k = 0; k < 3; ++k) {
      apart[k] = part.center[k] - all.cover.center[k];
    }
    all.cover.radius = std::max(all.cover.radius, length_under(all.A, apart) + part.radius);
    all.cover.extent = std::max(all.cover.extent, length(apart) + part.extent);
    all.cover.thin = std::max(all.cover.thin, part.thin);
  }
  return all;
}

// Rounded so that the bound comes out lower.
void put_lane(SolidCover& to, int lane, const Whitened& from) {
  std::size_t at = 0;
  for (std::size_t i = 0; i < 3; ++i) {
    to.center[i][lane] = static_cast<float>(from.cover.center[i]);
    for (std::size_t j = 0; j <= i; ++j) {
      to.whiten[at++][lane] = static_cast<float>(from.A[i][j]);
    }
  }
  const double rounding = 2.0 * static_cast<double>(kCoverRounding) * from.cover.thin * from.cover.extent;
  to.radius[lane] = static_cast<float>((from.cover.radius + rounding) * (1.0 + 1e-6));
  to.thin[lane] = static_cast<float>(from.cover.thin * (1.0 + 1e-6));
}

// Covers of a tree, whose children come after their parents; `leaf(i)` is the cover of leaf i, with its whitening.
template <class Leaf>
void cover_tree(std::span<const SolidNode> nodes, CoverTable& table, Leaf&& leaf) {
  table.nodes.assign(nodes.size(), SolidCover{});
  std::vector<Whitened> found(nodes.size());
  std::array<Cover, kFan> parts;
  for (std::size_t n = nodes.size(); n-- > 0;) {
    std::size_t count = 0;
    for (int lane = 0; lane < kFan; ++lane) {
      if (!std::isfinite(nodes[n].low[0][lane])) {
        continue;  // nothing is there
      }
      const std::int32_t child = nodes[n].child[lane];
      const Whitened below = child >= 0 ? found[static_cast<std::size_t>(child)] : leaf(static_cast<std::size_t>(~child));
      put_lane(table.nodes[n], lane, below);
      parts[count++] = below.cover;
    }
    found[n] = merged({parts.data(), count});
  }
  if (!nodes.empty()) {
    table.whole = found[0].cover;
  }
  table.bytes = table.nodes.size() * sizeof(SolidCover);
}

}  // namespace

const CoverTable& covers_of(const SolidBlock& block) {
  std::call_once(block.covers.once, [&block] {
    SolidLeaf room;
    std::array<Cover, kFan> parts;
    cover_tree(block.nodes, block.covers, [&](std::size_t i) {
      const SolidLeaf& leaf = leaf_at(block, i, room);
      std::size_t count = 0;
      for (int lane = 0; lane < kFan && leaf.id[lane] >= 0; ++lane) {
        parts[count++] = cover_of(leaf, lane);
      }
      return merged({parts.data(), count});
    });
  });
  return block.covers;
}

void cover_top(std::span<const SolidNode> top, BlockList blocks, CoverTable& table) {
  cover_tree(top, table, [&](std::size_t i) { return merged({&blocks[i]->covers.whole, 1}); });
}

}  // namespace splatbot
