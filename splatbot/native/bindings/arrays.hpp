// SPDX-License-Identifier: Apache-2.0
// Arrays as the rasterizers take and give them.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <initializer_list>
#include <memory>
#include <numeric>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "splatbot/rasterizer.hpp"

namespace nb = nanobind;

template <class T, class Shape>
using Array = nb::ndarray<T, Shape, nb::c_contig, nb::device::cpu>;
using InAny = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using OutAny = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using InMask = Array<const std::uint8_t, nb::shape<-1, -1>>;
using In1 = Array<const float, nb::shape<-1>>;
using In2 = Array<const float, nb::shape<-1, -1>>;
using In3 = Array<const float, nb::shape<-1, -1, -1>>;
using InN33 = Array<const float, nb::shape<-1, 3, 3>>;
using InN3 = Array<const float, nb::shape<-1, 3>>;
using InN4 = Array<const float, nb::shape<-1, 4>>;
using Out2 = Array<float, nb::shape<-1, -1>>;
using Out3 = Array<float, nb::shape<-1, -1, -1>>;
using OutDoubles = Array<double, nb::shape<-1>>;
using OutCamera = Array<double, nb::shape<splatbot::kCameraSums>>;
using Matrix3 = Array<const double, nb::shape<3, 3>>;
using Matrix4 = Array<const double, nb::shape<4, 4>>;

// The type of a parameter that may be None, and its name in Python; arrays are not converted.
template <class A>
using OrNone = const std::optional<A>&;
inline auto or_none(const char* name) { return nb::arg(name).noconvert().none(); }

template <class A>
auto span_of(const A& array) {
  return std::span(array.data(), array.size());
}

template <class T, class A>
std::span<T> span_of(const std::optional<A>& array) {
  return array ? std::span<T>(array->data(), array->size()) : std::span<T>();
}

// Flat arrays and how to read them, as Python hands them over for both passes.
inline splatbot::Gaussians gaussians_of(const InN3& means, OrNone<InN4> quats, OrNone<InN3> scales,
                                        OrNone<InN33> covars, const In1& opacities, const InAny& colors,
                                        int sh_degree) {
  splatbot::Gaussians g = {.count = means.shape(0),
                           .channels = 3,
                           .means = span_of(means),
                           .quats = span_of<const float>(quats),
                           .scales = span_of<const float>(scales),
                           .covars = span_of<const float>(covars),
                           .opacities = span_of(opacities),
                           .colors = span_of(colors),
                           .sh_degree = sh_degree};
  if (sh_degree < 0 && colors.ndim() == 2) {
    g.channels = static_cast<int>(colors.shape(1));
  } else if (sh_degree >= 0 && colors.ndim() == 3 && colors.shape(2) == 3) {
    g.coefficients = static_cast<int>(colors.shape(1));
  } else {
    throw std::invalid_argument("colors is neither (N, D) nor, with a degree, (N, K, 3)");
  }
  return g;
}

// The camera's centre is -R^-1 t; x -> R (x - origin) + translation, all in float64 before rounding.
inline splatbot::View view_of(const Matrix4& viewmat, const Matrix3& K, int width, int height,
                              const splatbot::Lens* lens = nullptr) {
  splatbot::View view{};
  if (lens != nullptr) {
    view.lens = *lens;
  }
  const auto r = [&](int i, int j) { return viewmat(i % 3, j % 3); };
  double determinant = 0.0, center[3] = {};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      const double cofactor = r(i + 1, j + 1) * r(i + 2, j + 2) - r(i + 1, j + 2) * r(i + 2, j + 1);
      center[j] -= cofactor * viewmat(i, 3);
      determinant += i == 0 ? cofactor * viewmat(0, j) : 0.0;
      view.rotation[3 * i + j] = static_cast<float>(viewmat(i, j));
    }
  }
  if (determinant == 0.0) {
    throw std::invalid_argument("the rotation of viewmat has no inverse");
  }
  for (int j = 0; j < 3; ++j) {
    view.origin[j] = static_cast<float>(center[j] / determinant);
    view.center_low[j] = static_cast<float>(center[j] / determinant - static_cast<double>(view.origin[j]));
  }
  for (int i = 0; i < 3; ++i) {
    double shift = viewmat(i, 3);
    for (int j = 0; j < 3; ++j) {
      shift += viewmat(i, j) * static_cast<double>(view.origin[j]);
    }
    view.translation[i] = static_cast<float>(shift);
  }
  view.fx = static_cast<float>(K(0, 0));
  view.fy = static_cast<float>(K(1, 1));
  view.cx = static_cast<float>(K(0, 2));
  view.cy = static_cast<float>(K(1, 2));
  view.width = width;
  view.height = height;
  return view;
}

// Returns the value of that name, for an argument that takes one of several.
template <class Value, std::size_t N>
Value choice_of(const char* argument, const std::string& name, const std::pair<const char*, Value> (&choices)[N]) {
  std::string names;
  for (std::size_t i = 0; i < N; ++i) {
    if (name == choices[i].first) {
      return choices[i].second;
    }
    names += (i == 0 ? "" : i + 1 < N ? ", " : " or ") + std::string(choices[i].first);
  }
  throw std::invalid_argument(std::string(argument) + " is '" + name + "', must be " + names);
}

inline splatbot::DepthMode depth_mode(const std::string& name) {
  using splatbot::DepthMode;
  return choice_of<DepthMode>("depth", name,
                              {{"none", DepthMode::none}, {"accumulated", DepthMode::accumulated}, {"expected", DepthMode::expected}});
}

// Destinations of the gradients that both kinds of splats have.
inline splatbot::Gradients gradients_of(OrNone<OutAny> means, OrNone<OutAny> quats, OrNone<OutAny> scales,
                                        OrNone<OutAny> opacities, OrNone<OutAny> colors, OrNone<OutCamera> camera,
                                        OrNone<OutDoubles> background, OrNone<OutAny> means2d, bool accumulate) {
  return {.means = span_of<float>(means),
          .quats = span_of<float>(quats),
          .scales = span_of<float>(scales),
          .covars = {},
          .opacities = span_of<float>(opacities),
          .colors = span_of<float>(colors),
          .camera = span_of<double>(camera),
          .background = span_of<double>(background),
          .means2d = span_of<float>(means2d),
          .absolute2d = {},
          .accumulate = accumulate};
}

// Returns result() after render(), which runs without the GIL, or (field, row) of an input that is not finite.
template <class Render, class Result>
nb::object unless_faulty(Render&& render, Result&& result) {
  std::optional<splatbot::Fault> fault;
  {
    const nb::gil_scoped_release release;
    fault = render();
  }
  if (fault) {
    return nb::make_tuple(nb::str(fault->field.data(), fault->field.size()), fault->row);
  }
  return nb::cast(result());
}

// A render's leftovers for its backward pass and its meta.
template <class Pointer>
struct StateHandle {
  Pointer state;
};

// The state that render(pointer) leaves, or (field, row) of an input that is not finite.
template <class State, class Render>
nb::object state_after(Render&& render) {
  State state;
  return unless_faulty([&] { return render(state.state); }, [&] { return std::move(state); });
}

template <class T>
nb::ndarray<nb::numpy, T> owned(std::vector<T>&& values, std::initializer_list<std::size_t> shape) {
  auto held = std::make_unique<std::vector<T>>(std::move(values));
  T* data = held->data();
  nb::capsule owner(held.release(), [](void* p) noexcept {
    const std::unique_ptr<std::vector<T>> released(static_cast<std::vector<T>*>(p));
  });
  return nb::ndarray<nb::numpy, T>(data, shape, owner);
}

inline std::size_t size_of(std::initializer_list<std::size_t> shape) {
  return std::accumulate(shape.begin(), shape.end(), std::size_t{1}, std::multiplies<>());
}

// A dict of new arrays.
class ArrayDict {
 public:
  // Adds zeros, to be written by fill().
  template <class T>
  std::span<T> add(const char* name, std::initializer_list<std::size_t> shape) {
    const nb::ndarray<nb::numpy, T> array = owned(std::vector<T>(size_of(shape)), shape);
    arrays_[name] = array;
    return {array.data(), array.size()};
  }

  // The dict after fill(), which runs without the GIL.
  template <class Fill>
  nb::dict filled(Fill&& fill) const {
    {
      const nb::gil_scoped_release release;
      fill();
    }
    return arrays_;
  }

 private:
  nb::dict arrays_;
};

// An array whose values fill() writes, without the GIL.
template <class T, class Fill>
nb::ndarray<nb::numpy, T> filled(std::initializer_list<std::size_t> shape, Fill&& fill) {
  std::vector<T> values(size_of(shape));
  {
    const nb::gil_scoped_release release;
    fill(std::span<T>(values));
  }
  return owned(std::move(values), shape);
}

// One number of each row, (R,).
template <class Row, class T>
nb::ndarray<nb::numpy, T> column(const std::vector<Row>& rows, T Row::* number) {
  return filled<T>({rows.size()}, [&](std::span<T> out) {
    for (std::size_t i = 0; i < rows.size(); ++i) {
      out[i] = rows[i].*number;
    }
  });
}

// N numbers of each row, (R, N).
template <class Row, class T, std::size_t N>
nb::ndarray<nb::numpy, T> column(const std::vector<Row>& rows, T (Row::*numbers)[N]) {
  return filled<T>({rows.size(), N}, [&](std::span<T> out) {
    for (std::size_t i = 0; i < rows.size(); ++i) {
      std::copy_n(rows[i].*numbers, N, out.begin() + static_cast<std::ptrdiff_t>(N * i));
    }
  });
}

inline nb::ndarray<nb::numpy, std::int64_t> indices_of(std::span<const std::uint32_t> ids) {
  return owned(std::vector<std::int64_t>(ids.begin(), ids.end()), {ids.size()});
}

inline nb::dict dict_of(const splatbot::TileInfo& info) {
  nb::dict d;
  d["tile_size"] = nb::make_tuple(info.tile_width, info.tile_height);
  d["tile_width"] = info.columns;
  d["tile_height"] = info.rows;
  d["n_isects"] = info.pairs;
  d["state_bytes"] = info.state_bytes;
  return d;
}

// Defines the Python class of such leftovers, with the methods of both kinds of splats.
template <class Handle>
nb::class_<Handle> define_state(nb::module_& m, const char* name, const char* doc, nb::dict (*describe)(const Handle&)) {
  return nb::class_<Handle>(m, name, doc)
      .def("describe", describe, "Projections as a dict of arrays.")
      .def("visible", [](const Handle& handle) { return indices_of(splatbot::visible_ids(*handle.state)); },
           "Indices (V,) of the splats in view.")
      .def("tiles", [](const Handle& handle) { return dict_of(splatbot::tile_info(*handle.state)); },
           "Tile grid, pairs and bytes held.");
}
