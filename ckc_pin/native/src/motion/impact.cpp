#include "motion/impact.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/Eigenvalues>

#include "loops/box_constrained.hpp"
#include "loops/joints.hpp"

namespace ckc {

// Only an elastic body between two others whose masses differ by more than a factor of 1e6 needs more rounds. The
// projection on the cone of all stops ends them.
constexpr long max_rounds = 4000;
constexpr int max_endings = 3;   // projections that end an impact
constexpr double same = 1e-10;   // relative difference of gap velocities
constexpr double pushed = 1e-6;  // of the largest force: what takes part

namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();

// Gap velocities in units in which A has a unit diagonal: all about the square root of an energy.
class Rounds {
 public:
  Rounds(const ImpactProblem& problem, const ImpactRound& apply)
      : problem_(problem), apply_(apply), m_(problem.g.size()) {
    scale_ = problem.A.diagonal().cwiseSqrt().cwiseInverse();
    A_ = scale_.asDiagonal() * problem.A * scale_.asDiagonal();
    g_ = scale_.cwiseProduct(problem.g);
    at_rest_ = scale_.cwiseProduct(problem.at_rest);
    slow_ = scale_.cwiseProduct(problem.slow).cwiseMax(at_rest_);
    impulses_.setZero(m_);
    jammed_.assign(static_cast<size_t>(m_), 0);
    if (m_ > 1) use_rank();
  }

  bool run(Vector& g) {
    for (long round = 0; round < max_rounds; ++round) {
      const double restitution = choose_stops();
      if (stops_.empty()) break;
      if (!reflect(restitution)) return false;
    }
    if (!end()) return false;
    g = g_.cwiseQuotient(scale_);
    return true;
  }

 private:
  void use_rank() {
    const Eigen::SelfAdjointEigenSolver<Matrix> eigen(A_);
    const auto& values = eigen.eigenvalues();
    // Gap velocities of stops that imply each other agree only up to how exactly the loops are closed.
    for (Eigen::Index k = 0; k < m_ && values(k) <= dependent * values(m_ - 1); ++k)
      g_ -= eigen.eigenvectors().col(k).dot(g_) * eigen.eigenvectors().col(k);
    if (values(0) <= dependent * values(m_ - 1)) find_jammed();
  }

  // Stops that push against each other, so that none of them can be left: forces y >= 0 on them that do nothing, A y = 0.
  // They have no restitution. Each program looks for y with a force on stops that are not known to be jammed.
  void find_jammed() {
    const Vector low = Vector::Zero(m_), high = Vector::Constant(m_, infinity);
    for (Eigen::Index attempt = 0; attempt < m_; ++attempt) {
      Vector others(m_), forces;
      for (Eigen::Index i = 0; i < m_; ++i) others(i) = jammed_[i] ? 0.0 : 1.0;
      if (!least_in_box(A_ + others * others.transpose(), -others, low, high, forces)) return;
      const double sum = others.dot(forces);
      if (!(forces.dot(A_ * forces) <= dependent * sum * sum)) return;
      for (Eigen::Index i = 0; i < m_; ++i) jammed_[i] |= forces(i) > pushed * forces.maxCoeff();
    }
  }

  double restitution_of(Eigen::Index i) const {
    const double e = jammed_[i] ? 0.0 : problem_.restitution(i);
    return -e * g_(i) > slow_(i) ? e : 0.0;
  }

  // Those that approach with the smallest restitution, and of those that rest what does not bounce back when it is pushed:
  // all of them in a round without restitution, else those that have none.
  double choose_stops() {
    stops_.clear();
    double restitution = infinity;
    for (Eigen::Index i = 0; i < m_; ++i)
      if (g_(i) < -at_rest_(i)) restitution = std::min(restitution, restitution_of(i));
    if (restitution == infinity) return restitution;
    for (Eigen::Index i = 0; i < m_; ++i)
      if (g_(i) < -at_rest_(i) ? restitution_of(i) == restitution
                               : g_(i) <= at_rest_(i) && (restitution == 0.0 || problem_.restitution(i) == 0.0))
        stops_.push_back(static_cast<int>(i));
    low_.setZero(static_cast<Eigen::Index>(stops_.size()));
    return restitution;
  }

  // A round at `stops_`, whose impulses are at least `low_`.
  bool reflect(double restitution) {
    const auto count = static_cast<Eigen::Index>(stops_.size());
    const Vector g = g_(stops_), high = Vector::Constant(count, infinity);
    const double size = g.lpNorm<Eigen::Infinity>();
    Vector impulses;
    if (!least_in_box(A_(stops_, stops_), g / size, low_, high, impulses)) return false;
    impulses *= size;
    impulses_.setZero();
    for (Eigen::Index i = 0; i < count; ++i) {
      const double impulse = (1.0 + restitution) * impulses(i);
      g_ += impulse * A_.col(stops_[i]);
      impulses_(stops_[i]) = impulse * scale_(stops_[i]);
    }
    for (Eigen::Index i = 0; i < count; ++i) {  // exact where rounding alone makes the difference
      const double reflected = -restitution * g(i);
      if (std::abs(g_(stops_[i]) - reflected) <= same * size) g_(stops_[i]) = reflected;
    }
    return apply_(stops_, impulses_, restitution);
  }

  // What still approaches is stopped, and bounces that would not rise are taken away, by a projection on one cone. Stops
  // that rest are held for it: to let go of one where another is taken back would go on and on.
  bool end() {
    for (int attempt = 0; attempt < max_endings; ++attempt) {
      stops_.clear();
      bool any = false;
      low_.setZero(m_);
      for (Eigen::Index i = 0; i < m_; ++i) {
        stops_.push_back(static_cast<int>(i));
        any |= g_(i) < -at_rest_(i) || (g_(i) > at_rest_(i) && g_(i) <= slow_(i));
        if (g_(i) >= -at_rest_(i) && g_(i) <= slow_(i)) low_(i) = -infinity;
      }
      if (!any) break;
      if (!reflect(0.0)) return false;
    }
    for (Eigen::Index i = 0; i < m_; ++i)
      if (g_(i) <= at_rest_(i)) g_(i) = 0.0;
    return true;
  }

  const ImpactProblem& problem_;
  const ImpactRound& apply_;
  const Eigen::Index m_;
  Matrix A_;
  Vector scale_, g_, at_rest_, slow_, low_, impulses_;
  Indices stops_;
  std::vector<char> jammed_;
};

}  // namespace

bool resolve_impact(const ImpactProblem& problem, const ImpactRound& round, Vector& g) {
  return Rounds(problem, round).run(g);
}

}  // namespace ckc
