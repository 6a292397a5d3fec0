#include "box.hpp"

#include <proxsuite/proxqp/dense/dense.hpp>

namespace ckc {

namespace qp = proxsuite::proxqp;

constexpr double exactly = 1e-12;  // of the program, whose numbers are about one
constexpr double far = 1e8;        // a bound that is never met
constexpr long most_iterations = 10000;

bool least_in_box(const Matrix& A, In b, In lower, In upper, Vector& x) {
  const auto n = A.rows();
  if (n == 1 && A(0, 0) > 0.0) {
    x.setConstant(1, std::min(std::max(-b(0) / A(0, 0), lower(0)), upper(0)));
    return true;
  }
  qp::dense::QP<double> program(n, 0, 0, true);
  program.settings.eps_abs = exactly, program.settings.eps_rel = 0.0;
  program.settings.max_iter = most_iterations;
  const auto none = proxsuite::nullopt;
  const Vector cost = b, low = lower.cwiseMax(-far), high = upper.cwiseMin(far);
  program.init(A, cost, none, none, none, none, none, low, high);
  program.solve();
  x = program.results.x.cwiseMax(lower).cwiseMin(upper);
  return program.results.info.status == qp::QPSolverOutput::PROXQP_SOLVED && x.allFinite();
}

}  // namespace ckc
