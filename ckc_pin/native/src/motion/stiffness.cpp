#include "motion/stiffness.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/Eigenvalues>

namespace ckc {

constexpr double decay_time_constants = 30;  // after which a mode has decayed
constexpr double min_gain = 3;  // ratio of the steps that stability requires to those that accuracy requires

bool is_stiff(const Matrix& jacobian, double duration) {
  const Eigen::EigenSolver<Matrix> solver(jacobian, false);
  double bound = 0.0, resolved = 0.0;
  for (const auto& mode : solver.eigenvalues()) {
    const double rate = std::abs(mode), decay = -mode.real();
    if (decay > 0.0) bound = std::max(bound, rate * duration);
    resolved =
        std::max(resolved, rate * (decay * duration > decay_time_constants ? decay_time_constants / decay : duration));
  }
  return bound >= min_gain * resolved;
}

}  // namespace ckc
