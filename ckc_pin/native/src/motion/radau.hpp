// Radau IIA: implicit collocation of order 5, 9 or 13, stiffly accurate, in one step, so that projection, events and
// held forces do it no harm.
//
// After E. Hairer and G. Wanner, Stiff differential equations solved by Radau methods, 1999; but the Jacobian is taken
// ahead, where the last step's polynomial leads, which saves half the Newton iterations of a controlled motion.
#pragma once

#include <complex>

#include <Eigen/LU>

#include "motion/method.hpp"

namespace ckc {

class Radau : public Method {
 public:
  Radau(System& system, Step& step, Work& work, const Tolerance& tolerance);

  bool step(double t_bound) override;
  bool between(double t, Out y) override;
  void retry(double length) override;
  void commit() override;
  void forget() override;
  const char* name() const override { return "Radau"; }
  int error_order() const override { return stages_; }

 private:
  using Complex = std::complex<double>;

  // A collocation polynomial from y at t on: its rate's series in Legendre's polynomials.
  struct Polynomial {
    Matrix series;
    Vector y;
    double t = 0.0, h = 0.0;
  };
  void integrals(double x);
  using Method::evaluate;
  void evaluate(const Polynomial& polynomial, double t, Out y);

  enum class Newton { converged, slow, impossible };
  void tabulate();
  void guess(double h);
  void extrapolate(double x, double h, Out y);  // y at t + x h, by the last step's polynomial
  bool new_jacobian(double h);
  void factorize(double h);
  void solve();
  Newton newton(double h);
  double error(const Vector& f, double h);
  void propose(double h, double size, double effort, double exponent);

  const int stages_, most_iterations_;
  Vector c_, e_;        // nodes; weights of the error estimate
  Matrix A_inverse_, to_series_;
  Vector basis_;        // the integrals of Legendre's polynomials somewhere
  Eigen::MatrixXcd V_, V_inverse_;  // A_inverse_ = V diag(lambda) V^-1, one of each pair
  Eigen::VectorXcd lambda_;

  // A block of the Jacobian, of numbers that move by themselves: the motion's, or a column's that y has beside it.
  struct Block {
    Matrix J;
    std::vector<std::pair<int, int>> rates;  // entries whose rate is another entry
    Indices rest, place;  // those that are not eliminated; where an entry is among them, else -1
    void begin();         // `rest` and `place` from `rates`
  };

  // lambda / h - J of a block, with the entries whose rate is another entry eliminated: x_i = h / lambda (b_i + x_j).
  template <class Scalar>
  struct Shifted {
    using Square = Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic>;
    using Column = Eigen::Matrix<Scalar, Eigen::Dynamic, 1>;
    Scalar shift;
    Square left;
    Column right, rest;
    Eigen::PartialPivLU<Square> lu;
    void compute(const Block& of, Scalar shift);
    void solve(const Block& of, const Eigen::Ref<const Column>& b, Eigen::Ref<Column> x);
  };

  // And of all of y: columns beside the motion are alike.
  template <class Scalar>
  struct Factors {
    Shifted<Scalar> motion, beside;
    void compute(const Radau& of, Scalar shift);
    void solve(const Radau& of, const Eigen::Ref<const typename Shifted<Scalar>::Column>& b,
               Eigen::Ref<typename Shifted<Scalar>::Column> x);
  };

  Matrix Z_, F_, dZ_;
  Matrix Z_dot_, X_;  // rates of the collocation polynomials, and with them of the whole motion
  Vector b_, x_stage_;
  Block motion_, beside_;
  bool alike_ = false;                    // columns beside the motion move as it does
  Factors<double> real_;                  // of the real eigenvalue
  std::vector<Factors<Complex>> pairs_;   // of the others
  Eigen::VectorXcd right_, correction_;
  Vector scale_, error_, y_stage_, f_stage_, real_right_, real_correction_;
  double factorized_ = 0.0;  // the length that the factors are of
  bool J_known_ = false, J_fresh_ = false;
  double contraction_ = 0.0, correction_size_ = 0.0;
  int iterations_ = 0, cautious_ = 0;
  double error_old_ = 0.0, length_old_ = 0.0, error_new_ = 0.0;
  Polynomial last_, made_;   // of the last step, and of the one just made
};

}  // namespace ckc
