#include "motion/collocation.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "motion/legendre.hpp"

namespace ckc {

constexpr double accurate = 1e-9;  // of |y|: how well two steps of different stages have to agree
constexpr int order = 12;          // in the length of a step: how its error is observed to grow
// What is left to the fixed point when the iteration on the stages ends: of the step itself; of the first one, which
// it is compared with; of one that a guess is extrapolated from.
constexpr double settled_ = 0.005 * accurate, compared = 0.1 * accurate, guessed = 1e-4;
constexpr int sweeps = 30;
constexpr double run_up = 0.4;     // of the step: what is integrated first, to extrapolate the rest from
constexpr double far_ = 0.03;      // of |y|: a guess that is as far off foretells a step that is not accurate;
constexpr double foretold = 1e-6;  // of how far off it is: the error of such a step, as observed
constexpr int places = 41;         // where they are compared
constexpr double infinity = std::numeric_limits<double>::infinity();

Collocation::Table::Table(int s)
    : nodes(gauss_nodes(s)),
      at_nodes(legendre(nodes, s + 1)),
      at_places(legendre(Vector::LinSpaced(places, -1.0, 1.0), s + 1)),
      derivation(legendre_derivation(s)) {
  Matrix integral = Matrix::Zero(s, s + 1);  // of each polynomial
  integral(0, 0) = integral(0, 1) = 1.0;
  for (int k = 1; k < s; ++k) integral(k, k + 1) = 1.0 / (2 * k + 1), integral(k, k - 1) = -1.0 / (2 * k + 1);
  integration = Matrix(legendre(nodes, s)).inverse() * integral;
}

Collocation::Collocation(Dae& system, Work& work, int few_stages, int many_stages)
    : system_(system), work_(work), few_(few_stages), many_(many_stages) {
  state_.setZero(system.size);
}

static double largest(const Matrix& a) { return a.cwiseAbs().maxCoeff<Eigen::PropagateNaN>(); }

bool Collocation::good() const { return error <= accurate; }

double Collocation::scale() const { return 0.9 * std::pow(accurate / std::max(error, 1e-300), 1.0 / order); }

void Collocation::at(double t_, Out y) const {
  Vector x(1);
  x(0) = (2 * t_ - t_old - t) / (t - t_old);
  y = series_ * legendre(x, series_.cols());
}

void Collocation::make(double t_, In y, double span, bool known) {
  const double length = known ? t - t_old : run_up * span, size = std::max(1.0, y.lpNorm<Eigen::Infinity>());
  t_old = t_, t = t_ + span, y_ = y;
  if (!known) {
    Vector start(y.size());
    if (!rate(t_old, y_, start)) start.setConstant(std::nan(""));
    guess_ = start.replicate(1, few_.nodes.size());
    collocate(few_, length, guessed, infinity);
  }
  guess(few_, length, span / length);
  const double off = collocate(few_, span, compared, far_ * size);
  if (!(off <= far_ * size)) {
    error = std::isfinite(off) ? foretold * off / size : infinity;
    return;
  }
  first_ = series_;
  guess(many_, span, 1.0);
  collocate(many_, span, settled_, infinity);
  const double gap = largest(series_ * many_.at_places - first_ * few_.at_places);
  error = std::isfinite(gap) ? gap / size : infinity;
}

// Solve the stages by fixed-point iteration from guess_, into series_; how far the first sweep went, in y.
double Collocation::collocate(const Table& table, double span, double settled, double far) {
  double off = std::nan(""), before = infinity;
  for (int sweep = 0; sweep < sweeps; ++sweep) {
    integrate(table, span);
    if (!series_.allFinite()) break;
    states_.noalias() = series_ * table.at_nodes;
    rates(table.nodes, span);
    const double change = largest(new_ - guess_) * span;
    if (sweep == 0) off = change;
    guess_ = new_;
    if (!(change < 0.5 * before) || off > far) break;  // diverging, or at rounding
    if (change * (sweep ? change / before : 1.0) <= settled) break;
    before = change;
  }
  integrate(table, span);
  return off;
}

void Collocation::integrate(const Table& table, double span) {
  series_.noalias() = (0.5 * span) * guess_ * table.integration;
  series_.col(0) += y_;
}

bool Collocation::rate(double at, In y, Out y_dot) {
  return work_.one_more() && system_.rate_on_closure(at, y, y_dot);
}

// y' at the stages, NaN where it does not exist.
void Collocation::rates(const Vector& nodes, double span) {
  new_.resizeLike(guess_);
  for (Eigen::Index k = 0; k < nodes.size(); ++k) {
    state_ = states_.col(k);
    if (!rate(t_old + span * (1 + nodes(k)) / 2, state_, new_.col(k)))
      new_.col(k).setConstant(std::nan(""));
  }
}

// guess_ of a step that is `further` times as long as the one that series_ is of.
void Collocation::guess(const Table& table, double length, double further) {
  const Table& own = series_.cols() == few_.nodes.size() + 1 ? few_ : many_;
  const Vector x = (1 + table.nodes.array()) * further - 1;
  guess_ = (2 / length) * (series_ * own.derivation) * legendre(x, own.nodes.size());
}

}  // namespace ckc
