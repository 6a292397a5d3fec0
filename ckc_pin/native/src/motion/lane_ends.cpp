#include "motion/lane_ends.hpp"

#include <algorithm>

#include "loops/two_rows.hpp"
#include "motion/dae.hpp"
#include "motion/energy_monitor.hpp"

namespace ckc {

namespace {

constexpr int width = CompiledTerms::members, rows = 2;
using Members = CompiledTerms::Members;

WITH_WIDEST_REGISTERS void find_ranks(const Members* J, const Members* J_dot, const Scales& scales, int n,
                                      Members& value, Members& rate) {
  find_rank_of_two_rows(&vector_of(*J), &vector_of(*J_dot), scales.rows.data(), scales.columns.data(), n,
                        vector_of(value), vector_of(rate));
}

// momentum = D' v, and the kinetic energy
WITH_WIDEST_REGISTERS void multiply_D(const Members* D, const std::vector<Indices>& pattern, const Members* v, int n,
                                      Members* momentum, Members& kinetic) {
  for (int j = 0; j < n; ++j) vector_of(momentum[j]) = Vector8{};
  Vector8 twice = {};
  for (int j = 0; j < n; ++j)
    for (int i : pattern[j]) {
      const Vector8 entry = vector_of(D[j * n + i]);
      vector_of(momentum[i]) += entry * vector_of(v[j]);
      if (i != j) vector_of(momentum[j]) += entry * vector_of(v[i]);
    }
  for (int j = 0; j < n; ++j) twice += vector_of(v[j]) * vector_of(momentum[j]);
  vector_of(kinetic) = 0.5 * twice;
}

WITH_WIDEST_REGISTERS void find_energies(const Members& kinetic, const Members& potential, const Members* momentum,
                                         const Members* v, int n, const Members& rtol, const Members& atol,
                                         Members& energy, Members& allowance) {
  Vector8 height = vector_of(potential);
  vector_of(energy) = vector_of(kinetic) + height;
  make_absolute(height);
  Vector8 sum = EnergyMonitor::rounding * (vector_of(kinetic) + height);
  for (int k = 0; k < n; ++k) {
    Vector8 p = vector_of(momentum[k]), rate = vector_of(v[k]);
    make_absolute(p), make_absolute(rate);
    sum += p * (vector_of(atol) + vector_of(rtol) * rate);
  }
  vector_of(allowance) = sum;
}

// Largest |x / unit|
WITH_WIDEST_REGISTERS void find_largest(const Members* x, const double* units, int size, Members& result) {
  Vector8 largest = {};
  for (int k = 0; k < size; ++k) {
    Vector8 value = vector_of(x[k]);
    make_absolute(value);
    if (units) value /= units[k];
    largest = value > largest ? value : largest;
  }
  vector_of(result) = largest;
}

WITH_WIDEST_REGISTERS void multiply_J(const Members* J, const Members* x, int n, Members* product) {
  Vector8 sums[rows] = {};
  for (int j = 0; j < n; ++j)
    for (int i = 0; i < rows; ++i) sums[i] += vector_of(J[j * rows + i]) * vector_of(x[j]);
  for (int i = 0; i < rows; ++i) vector_of(product[i]) = sums[i];
}

WITH_WIDEST_REGISTERS void find_square(const Members* x, int size, Members& square) {
  Vector8 sum = {};
  for (int k = 0; k < size; ++k) sum += vector_of(x[k]) * vector_of(x[k]);
  vector_of(square) = sum;
}

// x += step for the members that are chosen
WITH_WIDEST_REGISTERS void add_step(const Members* step, const Members& is_chosen, int size, Members* x) {
  const Vector8 zero = {};
  for (int k = 0; k < size; ++k)
    vector_of(x[k]) = vector_of(is_chosen) > zero ? vector_of(x[k]) + vector_of(step[k]) : vector_of(x[k]);
}

}  // namespace

void LaneEnds::compute(const Core& core, double tolerance, const Members* constants, const Members* y,
                       const Members* trig, const Members& rtol, const Members& atol) {
  const CompiledTerms& terms = *core.compiled;
  n_ = core.n;
  phi_.resize(rows), residual_.resize(rows), momentum_.resize(n_), step_.resize(n_), trig_.resize(2 * n_);
  J_.resize(rows * n_), J_dot_.resize(rows * n_), D_.resize(n_ * n_), y_.resize(2 * n_);
  const CompiledTerms::MembersAt at{y, trig, constants};
  const Members* v = y + n_;
  terms.evaluate_closures(at, phi_.data(), J_.data());
  monitor(core, at, v, rtol, atol);
  Members largest_phi, largest_rate, largest_v, largest_q;
  find_largest(phi_.data(), nullptr, rows, largest_phi);
  multiply_J(J_.data(), v, n_, residual_.data());
  find_largest(residual_.data(), nullptr, rows, largest_rate);
  find_largest(v, nullptr, n_, largest_v);
  find_largest(y, core.scales.columns.data(), n_, largest_q);
  bool projects_any = false;
  for (int lane = 0; lane < width; ++lane) {
    closure_tolerance_.of[lane] = tolerance * Tree::tolerance_factor(largest_q.of[lane]);
    const double drift = std::max(largest_phi.of[lane], largest_rate.of[lane] / (1.0 + largest_v.of[lane]));
    is_projected_[lane] = drift > closure_tolerance_.of[lane], newton_steps_[lane] = 0;
    is_valid_[lane] = std::isfinite(drift);
    projects_any = projects_any || is_projected_[lane];
  }
  std::copy_n(y, 2 * n_, y_.begin());
  if (projects_any) project(terms, at);
}

void LaneEnds::monitor(const Core& core, const CompiledTerms::MembersAt& at, const Members* v, const Members& rtol,
                       const Members& atol) {
  const CompiledTerms& terms = *core.compiled;
  terms.evaluate_J_dots(at, v, J_dot_.data());
  find_ranks(J_.data(), J_dot_.data(), core.scales, n_, rank_value_, rank_rate_);
  Members kinetic, potential;
  terms.evaluate_D_trees(at, D_.data());
  terms.evaluate_potential_energies(at, &potential);
  multiply_D(D_.data(), core.tree.inertia_pattern, v, n_, momentum_.data(), kinetic);
  find_energies(kinetic, potential, momentum_.data(), v, n_, rtol, atol, energy_, energy_allowance_);
}

// Project the members that have to be, the others stay as they are.
void LaneEnds::project(const CompiledTerms& terms, CompiledTerms::MembersAt at) {
  std::copy_n(at.trig, 2 * n_, trig_.begin());
  at.q = y_.data(), at.trig = trig_.data();
  Members* v = &y_[n_];
  while (choose_members_to_move()) {
    terms.closure_steps(at, phi_.data(), step_.data(), &is_sound_);
    add_step(step_.data(), is_chosen_, n_, y_.data());
    compute_cosines_and_sines_of_vectors(y_[0].of, n_ * width, trig_[0].of, trig_[n_].of);
    terms.evaluate_closures(at, phi_.data(), J_.data());
  }
  Members J_square, v_square, largest_rate;
  multiply_J(J_.data(), v, n_, residual_.data());
  find_largest(residual_.data(), nullptr, rows, largest_rate);
  find_square(J_.data(), rows * n_, J_square), find_square(v, n_, v_square);
  terms.closure_steps(at, residual_.data(), step_.data(), &is_sound_);
  for (int lane = 0; lane < width; ++lane) {
    const double size = std::sqrt(J_square.of[lane]) * std::sqrt(v_square.of[lane]);
    const bool is_needed = is_projected_[lane] && largest_rate.of[lane] > Dae::rate_rounding * size;
    is_chosen_.of[lane] = is_needed;
    is_valid_[lane] = is_valid_[lane] && (!is_needed || is_sound_.of[lane] > 0.0);
  }
  add_step(step_.data(), is_chosen_, n_, v);
}

bool LaneEnds::choose_members_to_move() {
  Members largest_phi;
  find_largest(phi_.data(), nullptr, rows, largest_phi);
  bool any = false;
  for (int lane = 0; lane < width; ++lane) {
    const bool was_chosen = newton_steps_[lane] > 0 && is_chosen_.of[lane] > 0.0,
               is_open = is_projected_[lane] && largest_phi.of[lane] > closure_tolerance_.of[lane];
    if ((was_chosen && !(is_sound_.of[lane] > 0.0)) || (is_open && newton_steps_[lane] == Dae::max_newton_steps))
      is_valid_[lane] = false;
    const bool moves = is_open && is_valid_[lane];
    is_chosen_.of[lane] = moves, newton_steps_[lane] += moves;
    any = any || moves;
  }
  return any;
}

bool LaneEnds::read(int lane, StepEnd& end) const {
  if (!is_valid_[lane]) return false;
  end.rank = {rank_value_.of[lane], rank_rate_.of[lane]};
  end.energy = energy_.of[lane], end.energy_allowance = energy_allowance_.of[lane];
  end.is_projected = is_projected_[lane], end.newton_steps = newton_steps_[lane];
  end.y.resize(2 * n_);
  for (int k = 0; k < 2 * n_; ++k) end.y(k) = y_[k].of[lane];
  return finite(end.y);
}

}  // namespace ckc
