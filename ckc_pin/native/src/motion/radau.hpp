// Radau IIA: implicit collocation of order 5, 9 or 13. It is stiffly accurate and a one-step method, so projections,
// events and held forces do not disturb it.
//
// After E. Hairer and G. Wanner, Stiff differential equations solved by Radau methods, 1999. The Jacobian is evaluated
// near the end of the step, on the extrapolated polynomial of the last step. This halves the Newton iterations of
// controlled motions.
#pragma once

#include <complex>

#include <Eigen/LU>

#include "motion/method.hpp"

namespace ckc {

class Radau : public Method {
 public:
  Radau(System& system, Step& step, Work& work, const Tolerance& tolerance);

  bool make_step(double t_bound) override;
  bool interpolate(double t, Out y) override;
  void reject_step(double step_size) override;
  void accept_step() override;
  void reset_history() override;
  const char* name() const override { return "Radau"; }
  int error_order() const override { return stages_; }

 private:
  using Complex = std::complex<double>;

  // A collocation polynomial that starts at (t, y), as the Legendre series of its rate.
  struct Polynomial {
    Matrix series;
    Vector y;
    double t = 0.0, h = 0.0;
  };
  void evaluate_legendre_integrals(double x);
  using Method::evaluate;
  void evaluate(const Polynomial& polynomial, double t, Out y);

  enum class Newton { converged, slow, impossible };
  void tabulate();
  void extrapolate_stages(double h);
  void extrapolate(double x, double h, Out y);  // at t + x h
  bool new_jacobian(double h);
  void factorize(double h);
  void solve_linear_system();
  Newton iterate(double h);
  double estimate_error(const Vector& f, double h);
  void propose_step_size(double h, double size, double effort, double exponent);

  const int stages_, max_iterations_;
  Vector c_, e_;                    // nodes; weights of the error estimate
  Matrix A_inverse_;                // inverse of the Runge-Kutta matrix
  Matrix to_series_;                // maps Z_ to a Legendre series, multiplied from the right
  Vector legendre_integrals_;       // integrals of the Legendre polynomials at one point
  Eigen::MatrixXcd V_, V_inverse_;  // A_inverse_ = V diag(lambda) V^-1; one eigenvalue of each conjugate pair
  Eigen::VectorXcd lambda_;

  // A diagonal block of the Jacobian: of the motion, or of one column of the integrand.
  struct Block {
    Matrix J;
    std::vector<std::pair<int, int>> rates;  // (i, j): the rate of entry i is entry j
    Indices remaining;                       // entries that are not eliminated
    Indices position;                        // by entry: its index in `remaining`, -1 if it is eliminated
    void update_indices();                   // from `rates`
  };

  // The factorized matrix lambda / h - J of a block. Entries whose rate is another entry are eliminated: x_i = h /
  // lambda (b_i + x_j).
  template <class Scalar>
  struct ShiftedBlock {
    using Square = Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic>;
    using Column = Eigen::Matrix<Scalar, Eigen::Dynamic, 1>;
    Scalar shift;
    Square matrix;
    Column solution, rhs;
    Eigen::PartialPivLU<Square> lu;
    void compute(const Block& of, Scalar shift);
    void solve(const Block& of, const Eigen::Ref<const Column>& b, Eigen::Ref<Column> x);
  };

  // The factorization for all of y. All columns of the integrand have the same block.
  template <class Scalar>
  struct Factors {
    ShiftedBlock<Scalar> motion, integrand;
    void compute(const Radau& of, Scalar shift);
    void solve(const Radau& of, const Eigen::Ref<const typename ShiftedBlock<Scalar>::Column>& b,
               Eigen::Ref<typename ShiftedBlock<Scalar>::Column> x);
  };

  Matrix Z_, dZ_;  // y at the stages relative to the start, and Newton's correction
  Matrix F_;       // right-hand sides at the stages
  Matrix Z_dot_;   // rates of the polynomial at the stages
  Matrix X_;       // rates of the full motion at the stages
  Vector b_;       // weights of the quadrature
  Vector x_stage_;
  Block motion_block_, integrand_block_;
  bool blocks_are_equal_ = false;                  // whether the integrand's block equals that of the motion
  Factors<double> real_factors_;                   // of the real eigenvalue
  std::vector<Factors<Complex>> complex_factors_;  // of the complex pairs
  Eigen::VectorXcd complex_rhs_, complex_correction_;
  Vector scale_, error_, y_stage_, f_stage_, real_rhs_, real_correction_;
  double factorized_step_ = 0.0;                      // step size of the factorization
  bool jacobian_is_valid_ = false;                    // accurate enough for the next step
  bool jacobian_is_fresh_ = false;                    // evaluated for the present step
  double contraction_ = 0.0, correction_size_ = 0.0;  // of the last Newton iteration
  int iterations_ = 0;
  int cautious_steps_left_ = 0;  // steps whose growth is limited
  double error_old_ = 0.0, h_old_ = 0.0, error_new_ = 0.0;
  Polynomial last_polynomial_, step_polynomial_;  // of the last accepted step, and of the new one
};

}  // namespace ckc
