// What acts on a mechanism: nothing, a constant u, one of the paper's controllers or a caller's own, sampled or not,
// through actuators with limits.
#pragma once

#include <cmath>
#include <limits>
#include <memory>
#include <optional>
#include <vector>

#include "desired.hpp"

namespace ckc {

// The state that a controller sees: the core there, with D' and the bias, and q, q_dot of the user's partition.
struct Measured {
  double t;
  Core& core;
  const Vector &q, &q_dot;
  const Vector& v_tree;  // what C takes its velocity from
  const Vector& rate;    // q_dot of the core's partition
};

// Why a controller has no u, or its caller's exception.
struct Problem {
  std::string says;
  Vector u;             // one that is not finite
  bool raised = false;  // an exception of the caller's, kept by who called it
};

class Controller {
 public:
  virtual ~Controller() = default;
  // Eq. 6's force; false where there is none.
  virtual bool u(const Measured& at, Out u, Problem& problem) = 0;
  // Its Lyapunov function; NaN where it has none here. w: what phi is.
  virtual double lyapunov(const Measured&, double, In) { return std::numeric_limits<double>::quiet_NaN(); }
  // Whether it looks at terms of q's own partition, or at q and q_dot alone.
  virtual bool needs_terms() const { return true; }
  // d u / d q and d u / d q_dot where they are known; false where not.
  virtual bool slopes(Matrix&, Matrix&) const { return false; }
};

// Eq. 14.
class SetPoint : public Controller {
 public:
  SetPoint(Matrix K_P, Matrix K_V, Vector q_d, Vector h_d, double potential_d);
  bool u(const Measured& at, Out u, Problem& problem) override;
  double lyapunov(const Measured& at, double potential_energy, In w) override;
  bool needs_terms() const override { return false; }
  bool slopes(Matrix& by_q, Matrix& by_q_dot) const override;

 private:
  Matrix K_P_, K_V_;
  Vector q_d_, h_d_;
  double potential_d_;
  Vector e_, product_;
};

// Eq. 16. `model`: the controller's own idea of the plant, at the measured q' and at rho q_dot, or "actual".
class Tracking : public Controller {
 public:
  Tracking(Matrix Lambda, Matrix K_D, std::unique_ptr<Motion> desired, std::unique_ptr<Core> model, bool actual);
  bool u(const Measured& at, Out u, Problem& problem) override;
  double lyapunov(const Measured& at, double potential_energy, In w) override;

 private:
  Matrix Lambda_, K_D_;
  std::unique_ptr<Motion> desired_;
  std::unique_ptr<Core> model_;
  bool actual_;
  bool errors(const Measured& at);
  Vector e_, e_dot_, v_, a_, r_, product_, v_model_;
};

// From u to tau by actuator, of minimum norm where there are more of them than freedoms, limited, and back.
class Actuation {
 public:
  Actuation(const Core& core, Indices at, bool direct, Vector limit);
  void apply(Core& core, Out u, Out tau, Out u_tree);
  const Indices at;
  const bool direct;  // u is what the actuators do
  bool limited(const Vector& tau, Eigen::Index k) const { return std::abs(tau(k)) >= limit_(k); }

 private:
  Vector limit_;  // infinite where there is none
  Matrix transmission_;
  Factor factor_;
};

// A clock that samples and holds: at k period the state is seen, from k period + delay on what came of it acts.
struct Sampling {
  double period = 0.0, delay = 0.0;
  long next = 0;  // the number of the next sample
  // A ring of what waits to act, u and when: `first` is the next, `count` how many there are.
  std::vector<std::pair<double, Vector>> ring;
  size_t first = 0, count = 0;

  double near(double t) const { return 1e-9 * period + 1e-15 * t; }  // instants nearer than that are one
  double instant() const;  // the next one
  void put(double t, In u);
};

class Control {
 public:
  Control(const Core& core, Indices actuated, bool direct, Vector limit);

  std::unique_ptr<Controller> law;  // null: only a constant u acts
  std::optional<Sampling> sampling;
  Vector constant;                      // (d)
  Problem problem;
  Vector u, tau, u_tree;            // what acts: (d), (actuators), (n)

  void begin();  // a run begins: nothing was sampled yet
  bool acts() const { return law || !constant.isZero(0); }
  // Whether the motion has to stay in the coordinates q that u is of: the law, or who steps, looks at terms in them, or
  // eq. 6's force has no other meaning.
  bool needs_own_partition() const { return acts() && !(law && !law->needs_terms() && actuation_.direct); }
  // Whether what acts between samples takes more of the state than q and q_dot.
  bool needs_terms() const { return acts() && !(actuation_.direct && !(feedback() && law->needs_terms())); }
  // d u' / d q' and d u' / d v', joints of one freedom alone, where u' was found last; false where that is not known.
  bool slopes(Matrix& by_q, Matrix& by_v);
  // Whether u follows the state between samples.
  bool feedback() const { return law && !sampling; }
  bool act(const Measured& at);
  bool sample(const Measured& at);  // at an instant of the clock
  double lyapunov(const Measured& at, double potential_energy, In w);

 private:
  bool ask(const Measured& at, Out u);
  Measured in_own_q(const Measured& at);
  Actuation actuation_;
  const Indices own_;  // q, whatever the coordinates of the motion are
  Vector sampled_, q_, q_dot_;
  Matrix slope_, slope_dot_;
};

}  // namespace ckc
