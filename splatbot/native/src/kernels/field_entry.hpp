// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "splatbot/field_kernels.hpp"

namespace splatbot::SPLATBOT_KERNELS {

void field_hits(const SolidsView& s, const SphereQueries& q, std::size_t begin, std::size_t end, std::uint8_t* out);
void field_nearest(const SolidsView& s, const SphereQueries& q, float cut, std::size_t begin, std::size_t end,
                   NearestSolid* out);
void field_k_nearest(const SolidsView& s, const SphereQueries& q, int k, float cut, std::size_t begin, std::size_t end,
                     double* distance, std::int32_t* id);
void field_mahalanobis(const SolidsView& s, const SolidCoversView& covers, const double* points,
                       const std::uint32_t* order, std::size_t begin, std::size_t end, double* distance,
                       std::int32_t* id);
void field_grid_bounds(const SolidsView& s, const double* points, std::size_t begin, std::size_t end, float* out);
void bound_columns(const BoundArgs& args, int y, std::uint8_t* steps);
void bound_slice(const BoundArgs& args, int z, std::uint16_t* line);

}  // namespace splatbot::SPLATBOT_KERNELS
