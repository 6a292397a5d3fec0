// One large Gauss collocation step across a singular position, where J loses rank.
//
// The motion is smooth there, but J does not determine it. The position is placed in the middle of the step, as far
// from the stages as possible. Each stage is projected onto the constraint manifold before it is evaluated: a
// violation would be divided by J's smallest singular value.
#pragma once

#include "motion/method.hpp"

namespace ckc {

class Collocation : public Interpolant {
 public:
  // Numbers of stages are even: an odd one has a stage in the middle, at the singular position. The step is accurate if
  // a polynomial of degree `run_up_stages` would do.
  Collocation(System& system, Work& work, const Tolerance& tolerance, int stages = 14, int run_up_stages = 10);

  // Step from (t, y) over a span whose middle is the singular position. `is_repeat`: the last step had the same start
  // and about the same span, so that it is the initial guess.
  void make_step(double t, In y, double span, bool is_repeat);
  void evaluate(double t, Out y) const;
  bool interpolate(double t, Out y) override { return evaluate(t, y), true; }
  // Whether the error is small enough. A step that has changed its branch is not accurate, because rates jump between
  // branches.
  bool is_accurate() const;
  // Factor of the step size with which the step would just be accurate.
  double step_scale() const;

  double t_old = 0, t = 0;
  double error = 0;  // of a polynomial of degree `run_up_stages`, and of the iteration, relative to |y|

 private:
  // Matrices for one number of stages. Polynomials are Legendre series, one row per degree, one column per entry of y.
  struct Table {
    explicit Table(int stages);
    Vector nodes;
    Matrix integration;           // from values at the nodes to the series of their integral
    Matrix integration_at_nodes;  // from values at the nodes to those of their integral
    Matrix differentiation;       // from a series to the series of its derivative
  };

  double solve_stages(const Table& table, double span, double tolerance, double max_first_change);
  void integrate(const Table& table, double span);
  void evaluate_rates(const Vector& nodes, double span);
  void extrapolate_guess(double length, double ratio);
  bool evaluate_rate(double t, In y, Out y_dot);

  System& system_;
  Work& work_;
  const Tolerance& tolerance_;
  const Table table_, run_up_;
  Matrix rest_at_points_;  // from the terms of a series of degree more than `run_up_stages` to their sum at points
  std::vector<std::pair<int, int>> rate_pairs_;  // entries of y of which the second is the rate of the first
  std::vector<bool> is_integrated_twice_;        // by entry of y: whether it is the first of a pair
  Vector y_, state_, rate_;
  double iteration_error_;  // expected change of y in the next sweep
  Matrix series_, guess_, states_, last_states_, rates_;  // the last three have one row per stage
  Matrix rate_corrections_;  // by stage and pair: change of the rate by the projection
};

}  // namespace ckc
