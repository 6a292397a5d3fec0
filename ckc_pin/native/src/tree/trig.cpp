#include "tree/trig.hpp"

#include <cmath>

#if defined(__x86_64__) && defined(__GLIBC__)
#include <dlfcn.h>
#include <immintrin.h>
#endif

namespace ckc {

namespace {

constexpr Eigen::Index lanes = 4;  // numbers per vector function call

void evaluate_scalar(const double* x, Eigen::Index count, double* cosines, double* sines) {
  for (Eigen::Index k = 0; k < count; ++k) cosines[k] = std::cos(x[k]);
  for (Eigen::Index k = 0; k < count; ++k) sines[k] = std::sin(x[k]);
}

using Evaluate = void (*)(const double* x, Eigen::Index count, double* cosines, double* sines);

#if defined(__x86_64__) && defined(__GLIBC__)

// Vector functions of glibc (four values at a time, within 4 units in the last place). They are loaded at run time
// because not every system has them.
using FourLanes = __m256d (*)(__m256d);
FourLanes cosine_lanes, sine_lanes;

__attribute__((target("avx2"))) void evaluate_avx2(const double* x, Eigen::Index count, double* cosines,
                                                   double* sines) {
  for (Eigen::Index k = 0; k < count; k += lanes) _mm256_storeu_pd(cosines + k, cosine_lanes(_mm256_loadu_pd(x + k)));
  for (Eigen::Index k = 0; k < count; k += lanes) _mm256_storeu_pd(sines + k, sine_lanes(_mm256_loadu_pd(x + k)));
}

Evaluate select_evaluation() {
  void* library = __builtin_cpu_supports("avx2") ? dlopen("libmvec.so.1", RTLD_NOW | RTLD_LOCAL) : nullptr;
  if (!library) return evaluate_scalar;
  cosine_lanes = reinterpret_cast<FourLanes>(dlsym(library, "_ZGVdN4v_cos"));
  sine_lanes = reinterpret_cast<FourLanes>(dlsym(library, "_ZGVdN4v_sin"));
  return cosine_lanes && sine_lanes ? evaluate_avx2 : evaluate_scalar;
}

#else

Evaluate select_evaluation() { return evaluate_scalar; }

#endif

}  // namespace

void compute_cosines_and_sines(const double* x, Eigen::Index count, double* cosines, double* sines) {
  static const Evaluate evaluate = select_evaluation();
  evaluate(x, count, cosines, sines);
}

const double* Trig::compute(In x) const {
  const Eigen::Index size = x.size(), padded_size = (size + lanes - 1) / lanes * lanes;
  if (x_.size() != size) padded_.setZero(padded_size), values_.setZero(size + padded_size);
  x_ = padded_.head(size) = x;
  // the sines overwrite the padding of the cosines
  compute_cosines_and_sines(padded_.data(), padded_size, values_.data(), values_.data() + size);
  return values_.data();
}

}  // namespace ckc
