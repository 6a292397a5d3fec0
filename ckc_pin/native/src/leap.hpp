// One large step across a position where J loses rank, by Gauss collocation: `simulation.leap`.
#pragma once

#include "dae.hpp"

namespace ckc {

class Leap {
 public:
  // Of a number of stages. Polynomials are Legendre series, a column a degree, and all of these act from the right.
  struct Table {
    Vector nodes;            // on [-1, 1]
    Matrix at_nodes;         // from a series to its values there
    Matrix at_places;        // and where leaps are compared
    Matrix integration;      // from values at the nodes to the series of their integral from -1 on
    Matrix derivation;       // from a series to that of its derivative
  };

  Leap(Dae& system, Table few, Table many);

  // Step from (t, y) over a span with the position at its middle. `known`: the last leap was from there too, over about
  // the same span.
  void make(double t, In y, double span, bool known);
  // y within the step.
  void at(double t, Out y) const;
  // Whether it is as accurate as it has to be, and so stayed on its branch.
  bool good() const;
  // How many times as long a leap as accurate as needed may be.
  double scale() const;

  double t_old = 0, t = 0;
  double error = 0;  // how far two leaps with different stages are apart, relative to |y|
  long rhs = 0;

 private:
  double collocate(const Table& table, double span, double settled, double far);
  void integrate(const Table& table, double span);
  void rates(const Vector& nodes, double span);
  void guess(const Table& table, double length, double further);

  Dae& system_;
  Table few_, many_;
  Vector y_, state_;
  Matrix series_, first_, guess_, states_, new_;
};

}  // namespace ckc
