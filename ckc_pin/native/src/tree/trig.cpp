#include "tree/trig.hpp"

#include <cmath>

#if defined(__x86_64__) && defined(__GLIBC__)
#include <dlfcn.h>
#include <immintrin.h>
#endif

namespace ckc {

namespace {

constexpr Eigen::Index lanes = 4;

void one_by_one(const double* x, Eigen::Index count, double* cosines, double* sines) {
  for (Eigen::Index k = 0; k < count; ++k) cosines[k] = std::cos(x[k]);
  for (Eigen::Index k = 0; k < count; ++k) sines[k] = std::sin(x[k]);
}

using Many = void (*)(const double* x, Eigen::Index count, double* cosines, double* sines);

#if defined(__x86_64__) && defined(__GLIBC__)

// The C library's own for four at a time, to its 4 units in the last place; not linked, since not every one has it.
using Four = __m256d (*)(__m256d);
Four cosine_of_four, sine_of_four;

__attribute__((target("avx2"))) void four_by_four(const double* x, Eigen::Index count, double* cosines, double* sines) {
  for (Eigen::Index k = 0; k < count; k += lanes)
    _mm256_storeu_pd(cosines + k, cosine_of_four(_mm256_loadu_pd(x + k)));
  for (Eigen::Index k = 0; k < count; k += lanes) _mm256_storeu_pd(sines + k, sine_of_four(_mm256_loadu_pd(x + k)));
}

Many found() {
  void* library = __builtin_cpu_supports("avx2") ? dlopen("libmvec.so.1", RTLD_NOW | RTLD_LOCAL) : nullptr;
  if (!library) return one_by_one;
  cosine_of_four = reinterpret_cast<Four>(dlsym(library, "_ZGVdN4v_cos"));
  sine_of_four = reinterpret_cast<Four>(dlsym(library, "_ZGVdN4v_sin"));
  return cosine_of_four && sine_of_four ? four_by_four : one_by_one;
}

#else

Many found() { return one_by_one; }

#endif

}  // namespace

const double* Trig::compute(In x) const {
  static const Many many = found();
  const Eigen::Index size = x.size(), whole = (size + lanes - 1) / lanes * lanes;
  if (x_.size() != size) padded_.setZero(whole), values_.setZero(size + whole);
  x_ = padded_.head(size) = x;
  // the cosines' padding is overwritten by the sines
  many(padded_.data(), whole, values_.data(), values_.data() + size);
  return values_.data();
}

}  // namespace ckc
