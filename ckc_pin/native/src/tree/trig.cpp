#include "tree/trig.hpp"

#include <cmath>

#if defined(__x86_64__) && defined(__GLIBC__)
#include <dlfcn.h>
#include <immintrin.h>
#endif

namespace ckc {

namespace {

void evaluate_scalar(const double* x, Eigen::Index count, double* cosines, double* sines) {
  for (Eigen::Index k = 0; k < count; ++k) cosines[k] = std::cos(x[k]);
  for (Eigen::Index k = 0; k < count; ++k) sines[k] = std::sin(x[k]);
}

using Evaluate = void (*)(const double* x, Eigen::Index count, double* cosines, double* sines);
struct Evaluations {
  Evaluate of_numbers = evaluate_scalar, of_vectors = evaluate_scalar;
};

#if defined(__x86_64__) && defined(__GLIBC__)

// Vector functions of glibc (within 4 units in the last place). They are loaded at run time because not every system has
// them. Those of eight numbers give the same digits as those of four.
using OfFour = __m256d (*)(__m256d);
using OfEight = __m512d (*)(__m512d);
OfFour cosines_of_four, sines_of_four;
OfEight cosines_of_eight, sines_of_eight;

// Numbers that were just stored in pairs are read in pairs: a wider read would wait for the stores.
__attribute__((target("avx2"))) inline __m256d read_four(const double* x) {
  return _mm256_insertf128_pd(_mm256_castpd128_pd256(_mm_loadu_pd(x)), _mm_loadu_pd(x + 2), 1);
}

__attribute__((target("avx2"))) void evaluate_avx2(const double* x, Eigen::Index count, double* cosines,
                                                   double* sines) {
  for (Eigen::Index k = 0; k < count; k += 4) _mm256_storeu_pd(cosines + k, cosines_of_four(read_four(x + k)));
  for (Eigen::Index k = 0; k < count; k += 4) _mm256_storeu_pd(sines + k, sines_of_four(read_four(x + k)));
}

__attribute__((target("avx512f"))) void evaluate_avx512(const double* x, Eigen::Index count, double* cosines,
                                                        double* sines) {
  for (Eigen::Index k = 0; k < count; k += 8) _mm512_storeu_pd(cosines + k, cosines_of_eight(_mm512_loadu_pd(x + k)));
  for (Eigen::Index k = 0; k < count; k += 8) _mm512_storeu_pd(sines + k, sines_of_eight(_mm512_loadu_pd(x + k)));
}

Evaluations select_evaluations() {
  void* library = __builtin_cpu_supports("avx2") ? dlopen("libmvec.so.1", RTLD_NOW | RTLD_LOCAL) : nullptr;
  if (!library) return {};
  cosines_of_four = reinterpret_cast<OfFour>(dlsym(library, "_ZGVdN4v_cos"));
  sines_of_four = reinterpret_cast<OfFour>(dlsym(library, "_ZGVdN4v_sin"));
  if (!cosines_of_four || !sines_of_four) return {};
  cosines_of_eight = reinterpret_cast<OfEight>(dlsym(library, "_ZGVeN8v_cos"));
  sines_of_eight = reinterpret_cast<OfEight>(dlsym(library, "_ZGVeN8v_sin"));
  const bool has_eight = __builtin_cpu_supports("avx512f") && cosines_of_eight && sines_of_eight;
  return {evaluate_avx2, has_eight ? evaluate_avx512 : evaluate_avx2};
}

#else

Evaluations select_evaluations() { return {}; }

#endif

const Evaluations& evaluations() {
  static const Evaluations selected = select_evaluations();
  return selected;
}

}  // namespace

void compute_cosines_and_sines(const double* x, Eigen::Index count, double* cosines, double* sines) {
  evaluations().of_numbers(x, count, cosines, sines);
}

void compute_cosines_and_sines_of_vectors(const double* x, Eigen::Index count, double* cosines, double* sines) {
  evaluations().of_vectors(x, count, cosines, sines);
}

const double* Trig::compute(In x) const {
  const Eigen::Index size = x.size(), padded_size = (size + 3) / 4 * 4;
  if (x_.size() != size) padded_.setZero(padded_size), values_.setZero(size + padded_size);
  x_ = padded_.head(size) = x;
  // the sines overwrite the padding of the cosines
  compute_cosines_and_sines(padded_.data(), padded_size, values_.data(), values_.data() + size);
  return values_.data();
}

}  // namespace ckc
