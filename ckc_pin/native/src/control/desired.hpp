// Desired trajectories q_d(t) with their first two derivatives: sums of sines, splines, or a point's path.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "loops/core.hpp"

namespace ckc {

// A function of time with two derivatives.
class Motion {
 public:
  virtual ~Motion() = default;
  // False where there is none: `problem` says why.
  virtual bool operator()(double t, Out x, Out x_dot, Out x_ddot) = 0;
  std::string problem;
};

class Harmonics : public Motion {
 public:
  // offset + sum of amplitude sin(frequency t + phase); (size, waves)
  Harmonics(Vector offset, Matrix amplitude, Matrix frequency, Matrix phase);
  bool operator()(double t, Out x, Out x_dot, Out x_ddot) override;

 private:
  Vector offset_;
  Matrix amplitude_, frequency_, phase_;
};

class Spline : public Motion {
 public:
  // Polynomials in pieces: by power, the highest first, a row of coefficients a piece.
  Spline(Vector breaks, std::vector<Matrix> coefficients);
  bool operator()(double t, Out x, Out x_dot, Out x_ddot) override;

 private:
  Vector breaks_;
  std::vector<Matrix> coefficients_;
};

// q_d(t) that takes a point along a path, by Newton's method on Psi(q') = [phi; the point's coordinates].
class PointMotion : public Motion {
 public:
  struct Task {
    Closure closure;      // of Psi and more
    Indices psi;          // its n rows that determine q'
    std::vector<int> axis;  // by row of psi: which of x, y, z it tells, -1 for one that keeps its level
    Vector level;         // of psi; zero where the path gives it
  };
  // `knots`: configurations along the path, (nq, count), at `times`; past `end` the path leaves the workspace.
  PointMotion(const std::string& model, Indices place, Task task, std::unique_ptr<Motion> path, Indices q,
              Vector times, Matrix knots, double tolerance, double end, std::string past_end);
  bool operator()(double t, Out x, Out x_dot, Out x_ddot) override;

 private:
  static constexpr int nodes = 3;  // of the interpolation between knots, of degree 5
  bool place();  // psi's rows at q_tree_; false where they are not finite, or determine nothing
  bool close();
  void fill(const Vector& path, const Vector* level);  // wanted_, one of psi's rows each
  bool knot_rate(Eigen::Index knot);
  bool predict(double t, Eigen::Index first);  // q_tree_, from the knots from there on

  Tree tree_;
  Rows rows_;
  Task task_;
  std::unique_ptr<Motion> path_;
  Indices q_;
  Vector times_;
  Matrix knots_;
  double tolerance_, end_;
  std::string past_end_;
  Matrix rates_;             // (n, count): how fast it moves at the knots,
  std::vector<char> known_;  // of which that was found; some are asked for, and the last may be singular
  Vector q_tree_, units_, v_, a_, wanted_, residual_, step_, J_dot_v_, x_, x_dot_, x_ddot_;
  Matrix J_;
  Factor factor_;
};

}  // namespace ckc
