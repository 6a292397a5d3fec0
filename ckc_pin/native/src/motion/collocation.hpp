// One large step across a position where J loses rank, by Gauss collocation with the position in its middle gap.
//
// The motion is smooth there, only J does not determine it. So the position is put in the middle of the step, as far
// from every stage as a stage can be, and each stage is put on the closure before it is evaluated: what is off the
// closure would come back divided by J's least singular value.
#pragma once

#include "motion/dae.hpp"
#include "motion/method.hpp"

namespace ckc {

class Collocation : public Interpolant {
 public:
  Collocation(Dae& system, Work& work, int few_stages = 10, int many_stages = 14);  // even: none in the middle

  // Step from (t, y) over a span with the position at its middle. `known`: the last one was from there too, over about
  // the same span.
  void make(double t, In y, double span, bool known);
  void at(double t, Out y) const;
  bool between(double t, Out y) override { return at(t, y), true; }
  // Whether it is as accurate as it has to be, and so stayed on its branch: off it the rates jump.
  bool good() const;
  // How many times as long a step as accurate as needed may be.
  double scale() const;

  double t_old = 0, t = 0;
  double error = 0;  // how far two steps with different stages are apart, relative to |y|

 private:
  // Of a number of stages. Polynomials are Legendre series, a column a degree, and all of these act from the right.
  struct Table {
    explicit Table(int stages);
    Vector nodes;
    Matrix at_nodes;     // from a series to its values there
    Matrix at_places;    // and where steps are compared
    Matrix integration;  // from values at the nodes to the series of their integral from -1 on
    Matrix derivation;
  };

  double collocate(const Table& table, double span, double settled, double far);
  void integrate(const Table& table, double span);
  void rates(const Vector& nodes, double span);
  void guess(const Table& table, double length, double further);
  bool rate(double t, In y, Out y_dot);

  Dae& system_;
  Work& work_;
  const Table few_, many_;
  Vector y_, state_;
  Matrix series_, first_, guess_, states_, new_;
};

}  // namespace ckc
