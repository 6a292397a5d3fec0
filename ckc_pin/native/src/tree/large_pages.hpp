// Large memory pages for matrices that are dense although few of their entries are used.
#pragma once

#include "tree/types.hpp"

#if defined(__linux__)
#include <sys/mman.h>

#include <cstdint>
#endif

namespace ckc {

// Set a matrix to zero. The columns of a large one lie on pages of their own: a visit of one entry in each would look
// up more addresses of pages than the processor remembers, so ask the system for larger pages.
inline void set_zero(Matrix& a, Eigen::Index rows, Eigen::Index columns) {
  a.resize(rows, columns);
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  constexpr std::uintptr_t large_page = 1u << 21;
  const auto begin = (reinterpret_cast<std::uintptr_t>(a.data()) + large_page - 1) / large_page * large_page,
             end = reinterpret_cast<std::uintptr_t>(a.data() + a.size()) / large_page * large_page;
  if (end > begin + large_page) madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
#endif
  a.setZero();
}

}  // namespace ckc
