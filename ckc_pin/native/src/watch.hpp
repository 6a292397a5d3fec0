// Watches for J losing rank and phi_z becoming singular, after every step: whether all is plainly well.
//
// What is to be done where it is not is Python's (`simulation.rank_guard`, `LevelSet.accept`).
#pragma once

#include <Eigen/Eigenvalues>

#include "system.hpp"

namespace ckc {

class Watch {
 public:
  // Scales that make J free of units.
  Watch(const Core& core, In row_scale, In column_scale);

  double chart_margin = 0.0;  // of phi_z, relative to |J|, from which on Python looks after it

  // J's least singular value that is not zero relative to the largest, and its rate, at the core's present state.
  struct Rank {
    double value = 0.0, rate = 0.0;
  };

  Rank rank(System& system);
  bool chart(const Core& core);  // whether phi_z is far enough from singular
  // Whether a position where J loses rank is so near that Python looks ahead.
  bool ahead(const Rank& end, double length) const;
  // Whether a step of length h between two such values passes no loss of rank.
  bool plain(const Rank& before, const Rank& after, double h) const;

 private:
  void direction(double value);  // u_: the eigenvector of gram_

  Vector row_scale_, column_scale_, v_, u_;
  Matrix scaled_, gram_, phi_z_, phi_z_gram_;
  Eigen::SelfAdjointEigenSolver<Matrix> eigen_, chart_eigen_;  // values only: vectors would allocate
  Factor shifted_;
};

}  // namespace ckc
