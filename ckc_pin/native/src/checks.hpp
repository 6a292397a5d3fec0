// What the bindings refuse: wrong sizes and numbers that are none. Nothing below them checks again.
#pragma once

#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>
#include <string>

#include "types.hpp"

namespace ckc {

namespace nb = nanobind;

using Given = nb::DRef<const Vector>;
using Table = nb::DRef<const Matrix>;

inline void require(bool holds, const std::string& says) {
  if (!holds) throw std::invalid_argument(says);
}

inline void require(In x, Eigen::Index size, const char* what) {
  require(x.size() == size, std::string(what) + ": " + std::to_string(size) + " numbers are needed, got " +
                                std::to_string(x.size()));
  require(x.allFinite(), std::string(what) + ": a number is not finite");
}

inline void require_square(const Matrix& m, Eigen::Index size, const char* what) {
  require(m.rows() == size && m.cols() == size && m.allFinite(),
          std::string(what) + ": a finite matrix of " + std::to_string(size) + " rows and columns is needed");
}

inline void require_indices(const Indices& at, int end, const char* what) {
  for (int k : at)
    require(k >= 0 && k < end, std::string(what) + ": " + std::to_string(k) + " is none of 0 to " +
                                   std::to_string(end - 1));
}

void bind_core(nb::module_& m);
void bind_systems(nb::module_& m);
void bind_loop(nb::module_& m);

}  // namespace ckc
