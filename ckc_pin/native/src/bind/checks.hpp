// Argument checks of the bindings: sizes and finite numbers. The core does not check them again.
#pragma once

#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>
#include <string>

#include "loops/core.hpp"

namespace ckc {

namespace nb = nanobind;

using VectorArg = nb::DRef<const Vector>;
using MatrixArg = nb::DRef<const Matrix>;

inline void require(bool condition, const std::string& message) {
  if (!condition) throw std::invalid_argument(message);
}

inline void require(In x, Eigen::Index size, const char* what) {
  require(x.size() == size,
          std::string(what) + ": " + std::to_string(size) + " numbers are needed, got " + std::to_string(x.size()));
  require(x.allFinite(), std::string(what) + ": a number is not finite");
}

inline void require_square(const Matrix& m, Eigen::Index size, const char* what) {
  require(m.rows() == size && m.cols() == size && m.allFinite(),
          std::string(what) + ": a finite matrix of " + std::to_string(size) + " rows and columns is needed");
}

inline void require_indices(const Indices& at, int end, const char* what) {
  for (int k : at)
    require(k >= 0 && k < end,
            std::string(what) + ": " + std::to_string(k) + " is none of 0 to " + std::to_string(end - 1));
}

template <class T>
T get(const nb::dict& table, const char* key) {
  require(table.contains(key), std::string("table: no key ") + key);
  return nb::cast<T>(table[key]);
}

// Return the model in Pinocchio's binary format.
inline std::string model_from_table(const nb::dict& table) {
  const auto model = get<nb::bytes>(table, "model");
  return {model.c_str(), model.size()};
}

// Read doubles from an array through the buffer protocol, which is ten times as fast as DLPack. False if the size
// differs.
inline bool read(nb::handle from, Out to) {
  Py_buffer buffer;
  if (PyObject_GetBuffer(from.ptr(), &buffer, PyBUF_STRIDES) != 0) return PyErr_Clear(), false;
  const bool fits = buffer.ndim == 1 && buffer.shape[0] == to.size() && buffer.itemsize == sizeof(double);
  const auto* data = static_cast<const char*>(buffer.buf);
  for (Eigen::Index i = 0; fits && i < to.size(); ++i)
    to(i) = *reinterpret_cast<const double*>(data + i * buffer.strides[0]);
  PyBuffer_Release(&buffer);
  return fits;
}

// Create a NumPy array; `data` points to its numbers.
inline nb::object array(size_t size, double*& data) {
  data = new double[size];
  nb::capsule owner(data, [](void* owned) noexcept { delete[] static_cast<double*>(owned); });
  return nb::cast(nb::ndarray<nb::numpy, double, nb::ndim<1>>(data, {size}, owner));
}

// Python lists of q and z, rebuilt only if the partition changes.
struct PartitionLists {
  Indices at;
  nb::object q, z;
  void update(const Core& core) {
    if (core.q != at || !q.is_valid()) at = core.q, q = nb::cast(core.q), z = nb::cast(core.z);
  }
};

// Build C++ objects from Python's tables, and look up a term by name.
std::unique_ptr<Core> core_from_table(const nb::dict& table);
std::unique_ptr<CompiledTerms> compiled_terms_from(const nb::tuple& library);  // (path, parameters)
Closure closure_from_table(const nb::dict& table);
SpringTable springs_from_table(const nb::dict& table);
nb::object term_by_name(Core& core, const std::string& name);

void bind_core(nb::module_& m);
void bind_loop(nb::module_& m);
void bind_gate(nb::module_& m);
void bind_batch(nb::module_& m);
void bind_many(nb::module_& m);
void bind_speed_profile(nb::module_& m);
void bind_linearization(nb::module_& m);

}  // namespace ckc
