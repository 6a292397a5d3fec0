#include "motion/stiffness.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/Eigenvalues>

namespace ckc {

constexpr double life = 30;  // time constants after which a mode is over
constexpr double gain = 3;   // how much longer than it has to be resolved a mode has to bind an explicit method

bool stiff(const Matrix& jacobian, double duration) {
  const Eigen::EigenSolver<Matrix> solver(jacobian, false);
  double bound = 0.0, resolved = 0.0;
  for (const auto& mode : solver.eigenvalues()) {
    const double rate = std::abs(mode), decay = -mode.real();
    if (decay > 0.0) bound = std::max(bound, rate * duration);
    resolved = std::max(resolved, rate * (decay * duration > life ? life / decay : duration));
  }
  return bound >= gain * resolved;
}

}  // namespace ckc
