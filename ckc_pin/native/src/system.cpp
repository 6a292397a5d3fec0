#include "system.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

constexpr double difference = 1.5e-8;  // step of forward differences, relative, or rad, m, and their rates

System::System(Core& core_, Control& control_, int size_) : core(core_), control(control_), size(size_) {
  velocity.setZero(core.n), v_tree.setZero(core.n), w.setZero(core.rows.closure.rows);
  q.setZero(core.d), q_dot.setZero(core.d);
}

double System::phi_z_margin() {
  if (!core.rank) return std::numeric_limits<double>::infinity();
  if (!phi_z_) {
    std::vector<Indices> pattern(core.rows.closure.rows);
    for (size_t i = 0; i < pattern.size(); ++i)
      for (int j : core.rows.pattern[i])
        if (std::find(core.z.begin(), core.z.end(), j) != core.z.end()) pattern[i].push_back(j);
    phi_z_ = std::make_unique<Spectrum>(std::move(pattern), core.n, core.rank);
  }
  core.jacobian();
  const Vector &rows = core.scales.rows, &columns = core.scales.columns;
  phi_z_->compute(core.rows.J, rows, columns);
  double square = 0.0;
  for (int i = 0; i < core.rows.closure.rows; ++i)
    for (int j : core.rows.pattern[i]) {
      const double scaled = rows(i) * core.rows.J(i, j) * columns(j);
      square += scaled * scaled;
    }
  return phi_z_->least() / std::max(std::sqrt(square), 1e-300);
}

bool System::jacobian(double t, In y, Matrix& jacobian, long& evaluations) {
  jacobian.resize(size, size), rate_.resize(size), rate_here_.resize(size);
  moved_ = y;
  ++evaluations;
  if (!rhs(t, moved_, rate_here_)) return false;
  for (int k = 0; k < size; ++k) {
    moved_(k) = y(k) + difference * std::max(1.0, std::abs(y(k)));
    const double step = moved_(k) - y(k);
    ++evaluations;
    if (!rhs(t, moved_, rate_)) return false;
    jacobian.col(k) = (rate_ - rate_here_) / step;
    moved_(k) = y(k);
  }
  return jacobian.allFinite();
}

}  // namespace ckc
