// Desired trajectories q_d(t) with two derivatives: sums of sines, piecewise polynomials, sums of both, or a point.
#pragma once

#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "loops/core.hpp"

namespace ckc {

// A vector function of time with two derivatives.
class Trajectory {
 public:
  virtual ~Trajectory() = default;
  // Evaluate at t. False if undefined there; `failure` says why.
  virtual bool operator()(double t, Out x, Out x_dot, Out x_ddot) = 0;
  // Times from now on lie in [begin, end], up to the tolerance. Where derivatives jump at an end, evaluate the limit
  // from inside, so that a step which ends there does not see the jump.
  virtual void set_segment(double /*begin*/, double /*end*/, double /*tolerance*/) {}
  std::string failure;
};

class HarmonicTrajectory : public Trajectory {
 public:
  // offset + sum of amplitude sin(frequency t + phase); matrices are (size, waves).
  HarmonicTrajectory(Vector offset, Matrix amplitude, Matrix frequency, Matrix phase);
  bool operator()(double t, Out x, Out x_dot, Out x_ddot) override;

 private:
  Vector offset_;
  Matrix amplitude_, frequency_, phase_;
};

class SplineTrajectory : public Trajectory {
 public:
  // Piecewise polynomials. `coefficients`: one matrix per power, the highest first, with one row per piece.
  SplineTrajectory(Vector breaks, std::vector<Matrix> coefficients);
  bool operator()(double t, Out x, Out x_dot, Out x_ddot) override;
  void set_segment(double begin, double end, double tolerance) override;

 private:
  Eigen::Index piece_at(double t) const;
  Vector breaks_;
  std::vector<Matrix> coefficients_;
  // A segment, with its tolerance, and its pieces. Empty at first.
  double begin_ = std::numeric_limits<double>::infinity(), end_ = -begin_;
  Eigen::Index first_ = 0, last_ = 0;
};

class SumTrajectory : public Trajectory {
 public:
  SumTrajectory(std::vector<std::unique_ptr<Trajectory>> parts, Eigen::Index size);
  bool operator()(double t, Out x, Out x_dot, Out x_ddot) override;
  void set_segment(double begin, double end, double tolerance) override;

 private:
  std::vector<std::unique_ptr<Trajectory>> parts_;
  Vector x_, x_dot_, x_ddot_;  // of a part
};

// q_d(t) that moves a point along a path, by Newton's method on Psi(q') = [phi; coordinates of the point].
class PointTrajectory : public Trajectory {
 public:
  struct Task {
    std::string model;      // in Pinocchio's binary format
    Indices q_index;        // for each tangent coordinate, its index in q'
    Closure closure;        // rows of the loops and coordinates of the point
    Indices psi;            // the n rows of `closure` that make up Psi and determine q'
    std::vector<int> axis;  // by row of Psi: the coordinate of the path that it equals, -1 for a constant
    Vector level;           // constant values of Psi; zero where the path prescribes them
  };
  // Configurations along the path, (nq, count), at their times. After `end` the path leaves the workspace.
  struct Knots {
    Vector times;
    Matrix configurations;
    double end;
    std::string past_end_message;
  };
  // `path`: of the point; `q`: the coordinates of q_d; `tolerance`: of |Psi|.
  PointTrajectory(Task task, std::unique_ptr<Trajectory> path, Indices q, Knots knots, double tolerance);
  bool operator()(double t, Out x, Out x_dot, Out x_ddot) override;
  void set_segment(double begin, double end, double tolerance) override {
    path_->set_segment(begin, end, tolerance);
  }

 private:
  static constexpr int nodes = 3;  // points interpolated between knots, by polynomials of degree 5
  bool update_rows();              // Psi and its Jacobian at q_tree_; false if not finite or singular
  bool solve();                    // for q_tree_
  void set_target(const Vector& path, const Vector* level);  // target_: values (or rates) that Psi should have
  bool compute_knot_rate(Eigen::Index knot);
  bool predict(double t, Eigen::Index first);  // sets q_tree_ from the knots beginning with `first`

  Tree tree_;
  ConstraintRows constraints_;
  Task task_;
  std::unique_ptr<Trajectory> path_;
  Indices q_;
  Knots knots_;
  double tolerance_;
  Matrix rates_;                     // (n, count): rates at the knots, computed when they are needed
  std::vector<char> rate_is_known_;  // by knot
  Vector q_tree_, units_, v_, a_, target_, residual_, step_, J_dot_v_, x_, x_dot_, x_ddot_;
  Matrix J_;
  Factor factor_;
};

}  // namespace ckc
