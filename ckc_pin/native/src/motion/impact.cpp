#include "motion/impact.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/Eigenvalues>

#include "loops/box_constrained.hpp"
#include "loops/joints.hpp"

namespace ckc {

// Only an elastic body between two others whose masses differ by more than a factor of 1e6 needs more rounds. The
// final projection on the cone of all stops ends them.
constexpr long max_rounds = 4000;
constexpr int max_final_projections = 3;
constexpr double reflection_tolerance = 1e-10;  // relative rounding of a reflected gap rate
constexpr double min_relative_force = 1e-6;     // of a jammed stop, relative to the largest force

namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();

// Resolves one impact. Gap rates are scaled so that A has a unit diagonal; they are about the square root of an
// energy.
class ImpactSolver {
 public:
  ImpactSolver(const ImpactProblem& problem, const ImpactRound& apply)
      : problem_(problem), apply_(apply), m_(problem.gap_rates.size()) {
    scale_ = problem.A.diagonal().cwiseSqrt().cwiseInverse();
    A_ = scale_.asDiagonal() * problem.A * scale_.asDiagonal();
    gap_rates_ = scale_.cwiseProduct(problem.gap_rates);
    rest_speed_ = scale_.cwiseProduct(problem.rest_speed);
    min_bounce_speed_ = scale_.cwiseProduct(problem.min_bounce_speed).cwiseMax(rest_speed_);
    impulses_.setZero(m_);
    jammed_.assign(static_cast<size_t>(m_), 0);
    if (m_ > 1) project_on_range();
  }

  bool solve(Vector& gap_rates) {
    for (long round = 0; round < max_rounds; ++round) {
      const double restitution = choose_stops();
      if (stops_.empty()) break;
      if (!reflect(restitution)) return false;
    }
    if (!finish()) return false;
    gap_rates = gap_rates_.cwiseQuotient(scale_);
    return true;
  }

 private:
  void project_on_range() {
    const Eigen::SelfAdjointEigenSolver<Matrix> eigen(A_);
    const auto& values = eigen.eigenvalues();
    // Gap rates of dependent stops agree only within the tolerance of the closure.
    for (Eigen::Index k = 0; k < m_ && values(k) <= dependent_row_tolerance * values(m_ - 1); ++k)
      gap_rates_ -= eigen.eigenvectors().col(k).dot(gap_rates_) * eigen.eigenvectors().col(k);
    if (values(0) <= dependent_row_tolerance * values(m_ - 1)) find_jammed_stops();
  }

  // Find jammed stops, which push against each other so that no joint can leave its stop: there are forces y >= 0 with
  // A y = 0. They have no restitution. Each quadratic program finds forces on stops that are not yet known to be
  // jammed.
  void find_jammed_stops() {
    const Vector low = Vector::Zero(m_), high = Vector::Constant(m_, infinity);
    for (Eigen::Index attempt = 0; attempt < m_; ++attempt) {
      Vector not_jammed(m_), forces;
      for (Eigen::Index i = 0; i < m_; ++i) not_jammed(i) = jammed_[i] ? 0.0 : 1.0;
      if (!minimize_in_box(A_ + not_jammed * not_jammed.transpose(), -not_jammed, low, high, forces)) return;
      const double sum = not_jammed.dot(forces);
      if (!(forces.dot(A_ * forces) <= dependent_row_tolerance * sum * sum)) return;
      for (Eigen::Index i = 0; i < m_; ++i) jammed_[i] |= forces(i) > min_relative_force * forces.maxCoeff();
    }
  }

  double restitution_of(Eigen::Index i) const {
    const double e = jammed_[i] ? 0.0 : problem_.restitution(i);
    return -e * gap_rates_(i) > min_bounce_speed_(i) ? e : 0.0;
  }

  // Select the stops of the next round: those that approach with the smallest restitution, and resting stops without
  // restitution (in a round without restitution, all resting stops).
  double choose_stops() {
    stops_.clear();
    double restitution = infinity;
    for (Eigen::Index i = 0; i < m_; ++i)
      if (gap_rates_(i) < -rest_speed_(i)) restitution = std::min(restitution, restitution_of(i));
    if (restitution == infinity) return restitution;
    for (Eigen::Index i = 0; i < m_; ++i)
      if (gap_rates_(i) < -rest_speed_(i)
              ? restitution_of(i) == restitution
              : gap_rates_(i) <= rest_speed_(i) && (restitution == 0.0 || problem_.restitution(i) == 0.0))
        stops_.push_back(static_cast<int>(i));
    lower_bounds_.setZero(static_cast<Eigen::Index>(stops_.size()));
    return restitution;
  }

  // Reflect the selected stops, with impulses of at least `lower_bounds_`.
  bool reflect(double restitution) {
    const auto count = static_cast<Eigen::Index>(stops_.size());
    const Vector gap_rates = gap_rates_(stops_), high = Vector::Constant(count, infinity);
    const double size = gap_rates.lpNorm<Eigen::Infinity>();
    Vector impulses;
    if (!minimize_in_box(A_(stops_, stops_), gap_rates / size, lower_bounds_, high, impulses)) return false;
    impulses *= size;
    impulses_.setZero();
    for (Eigen::Index i = 0; i < count; ++i) {
      const double impulse = (1.0 + restitution) * impulses(i);
      gap_rates_ += impulse * A_.col(stops_[i]);
      impulses_(stops_[i]) = impulse * scale_(stops_[i]);
    }
    for (Eigen::Index i = 0; i < count; ++i) {  // remove the rounding of reflected rates
      const double reflected = -restitution * gap_rates(i);
      if (std::abs(gap_rates_(stops_[i]) - reflected) <= reflection_tolerance * size) gap_rates_(stops_[i]) = reflected;
    }
    return apply_(stops_, impulses_, restitution);
  }

  // Stop joints that still approach, and remove bounces that are too slow, by a projection on one cone. Joints that
  // rest at their stops are held: otherwise releasing one and removing the bounce of another could alternate forever.
  bool finish() {
    for (int attempt = 0; attempt < max_final_projections; ++attempt) {
      stops_.clear();
      bool needs_projection = false;
      lower_bounds_.setZero(m_);
      for (Eigen::Index i = 0; i < m_; ++i) {
        stops_.push_back(static_cast<int>(i));
        needs_projection |= gap_rates_(i) < -rest_speed_(i) ||
                            (gap_rates_(i) > rest_speed_(i) && gap_rates_(i) <= min_bounce_speed_(i));
        if (gap_rates_(i) >= -rest_speed_(i) && gap_rates_(i) <= min_bounce_speed_(i)) lower_bounds_(i) = -infinity;
      }
      if (!needs_projection) break;
      if (!reflect(0.0)) return false;
    }
    for (Eigen::Index i = 0; i < m_; ++i)
      if (gap_rates_(i) <= rest_speed_(i)) gap_rates_(i) = 0.0;
    return true;
  }

  const ImpactProblem& problem_;
  const ImpactRound& apply_;
  const Eigen::Index m_;
  Matrix A_;
  Vector scale_, gap_rates_, rest_speed_, min_bounce_speed_, lower_bounds_, impulses_;
  Indices stops_;
  std::vector<char> jammed_;
};

}  // namespace

bool resolve_impact(const ImpactProblem& problem, const ImpactRound& round, Vector& gap_rates) {
  return ImpactSolver(problem, round).solve(gap_rates);
}

}  // namespace ckc
