// Functions whose loops are compiled several times, for processors with wider vector registers. The version of the
// processor is taken when the library is loaded; sums and products are not fused, so that all versions have the same digits.
#pragma once

#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__clang__)
#define WITH_WIDEST_REGISTERS __attribute__((target_clones("default", "avx2", "avx512f")))
#else
#define WITH_WIDEST_REGISTERS
#endif
// Functions that are compiled as a part of those that call them.
#define ALWAYS_INLINE __attribute__((always_inline)) inline

namespace ckc {

// Eight numbers as one vector. The compiler would vectorize loops over them along another loop, or not at all.
typedef double Vector8 __attribute__((vector_size(8 * sizeof(double)), may_alias, aligned(sizeof(double))));

ALWAYS_INLINE void make_absolute(Vector8& x) { x = x < -x ? -x : x; }

}  // namespace ckc
