#include "leap.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace ckc {

// As in `simulation.leap`.
constexpr double run_up = 0.4, accurate = 1e-9, compared = 0.1 * accurate, settled_ = 0.005 * accurate;
constexpr double guessed = 1e-4, far_ = 0.03, foretold = 1e-6;
constexpr int order = 12, sweeps = 30;
constexpr double infinity = std::numeric_limits<double>::infinity();

Leap::Leap(Dae& system, Table few, Table many) : system_(system), few_(std::move(few)), many_(std::move(many)) {
  state_.setZero(system.size);
}

static double largest(const Matrix& a) { return a.cwiseAbs().maxCoeff<Eigen::PropagateNaN>(); }

bool Leap::good() const { return error <= accurate; }

double Leap::scale() const { return 0.9 * std::pow(accurate / std::max(error, 1e-300), 1.0 / order); }

// Legendre's first polynomials at places, a row a degree.
static Matrix polynomials(const Vector& x, Eigen::Index count) {
  Matrix values(count, x.size());
  values.row(0).setOnes();
  if (count > 1) values.row(1) = x.transpose();
  for (Eigen::Index k = 1; k + 1 < count; ++k)
    values.row(k + 1) =
        (static_cast<double>(2 * k + 1) * values.row(k).cwiseProduct(x.transpose()) - k * values.row(k - 1)) / (k + 1);
  return values;
}

void Leap::at(double t_, Out y) const {
  Vector x(1);
  x(0) = (2 * t_ - t_old - t) / (t - t_old);
  y = series_ * polynomials(x, series_.cols());
}

void Leap::make(double t_, In y, double span, bool known) {
  const double length = known ? t - t_old : run_up * span, size = std::max(1.0, y.lpNorm<Eigen::Infinity>());
  t_old = t_, t = t_ + span, y_ = y;
  if (!known) {
    Vector rate(y.size());
    ++rhs;
    if (!system_.rate_on_closure(t_old, y_, rate)) rate.setConstant(std::nan(""));
    guess_ = rate.replicate(1, few_.nodes.size());
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
double Leap::collocate(const Table& table, double span, double settled, double far) {
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

void Leap::integrate(const Table& table, double span) {
  series_.noalias() = (0.5 * span) * guess_ * table.integration;
  series_.col(0) += y_;
}

// y' at the stages, NaN where it does not exist.
void Leap::rates(const Vector& nodes, double span) {
  new_.resizeLike(guess_);
  for (Eigen::Index k = 0; k < nodes.size(); ++k) {
    state_ = states_.col(k);
    ++rhs;
    if (!system_.rate_on_closure(t_old + span * (1 + nodes(k)) / 2, state_, new_.col(k)))
      new_.col(k).setConstant(std::nan(""));
  }
}

// guess_ of a step that is `further` times as long as the one that series_ is of.
void Leap::guess(const Table& table, double length, double further) {
  const Table& own = series_.cols() == few_.nodes.size() + 1 ? few_ : many_;
  const Vector x = (1 + table.nodes.array()) * further - 1;
  guess_ = (2 / length) * (series_ * own.derivation) * polynomials(x, own.nodes.size());
}

}  // namespace ckc
