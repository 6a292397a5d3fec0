// SciPy's BDF: variable order 1 to 5, quasi-constant steps, on differences; with SciPy's step control.
#pragma once

#include "linear.hpp"
#include "method.hpp"

namespace ckc {

class Bdf : public Method {
 public:
  Bdf(Tolerance tolerance, double newton_tolerance, int size);

  bool step(System& system, double t_bound) override;
  bool between(System& system, double t, Out y) override;
  void commit() override;

  static constexpr int most = 5;  // order
  struct State {
    Matrix D;  // (size, most + 3): differences
    int order = 1, equal = 0;  // equal: steps of one length so far
  };
  State now;
  Matrix J;  // of the right-hand side, not necessarily here

 private:
  using Differences = Eigen::Matrix<double, most + 1, most + 1>;

  static Differences ratio(int order, double factor);
  void rescale(double factor);
  bool solve(System& system, double c, int& iterations, bool& exists);
  void choose_order(double safety, double error);
  double norm(In x) const;

  Tolerance tolerance_;
  double newton_tolerance_;
  State next_;
  Factor lu_;
  bool factored_ = false;
  double gamma_[most + 1], alpha_[most + 1], error_[most + 1];
  Vector predicted_, scale_, psi_, d_, f_y_, dy_, right_;
  Matrix matrix_, changed_;
};

}  // namespace ckc
