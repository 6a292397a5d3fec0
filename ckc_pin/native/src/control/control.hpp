// What acts on a mechanism: nothing, a constant u, one of the paper's controllers or a caller's own, sampled or not,
// through actuators with limits.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <vector>

#include "control/allocation.hpp"
#include "control/desired.hpp"
#include "control/sensor.hpp"

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
  // Eq. 6's force, or the motors' torques; false where there is none.
  virtual bool u(const Measured& at, Out u, Problem& problem) = 0;
  virtual bool of_motors() const { return false; }
  // Its Lyapunov function; NaN where it has none here. w: what phi is.
  virtual double lyapunov(const Measured&, double, In) { return std::numeric_limits<double>::quiet_NaN(); }
  // Whether it looks at terms of q's own partition, or at q and q_dot alone.
  virtual bool needs_terms() const { return true; }
  // d u / d q' and d u / d v', tangent, of the last u, at the core's state; zero so far; `own`: q. False where unknown.
  virtual bool slopes(Core&, const Indices&, Matrix&, Matrix&) { return false; }
  // What u would be more, where `slopes` has found how it changes, if gains were more by this: of positions, of rates.
  virtual void by_gains(const Measured&, const Matrix&, const Matrix&, Out more) { more.setZero(); }
};

// Eq. 14.
class SetPoint : public Controller {
 public:
  SetPoint(Matrix K_P, Matrix K_V, Vector q_d, Vector h_d, double potential_d);
  bool u(const Measured& at, Out u, Problem& problem) override;
  double lyapunov(const Measured& at, double potential_energy, In w) override;
  bool needs_terms() const override { return false; }
  bool slopes(Core&, const Indices& own, Matrix& by_q, Matrix& by_v) override;
  void by_gains(const Measured& at, const Matrix& K_P, const Matrix& K_V, Out more) override;

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
  bool slopes(Core& plant, const Indices& own, Matrix& by_q, Matrix& by_v) override;
  void by_gains(const Measured& at, const Matrix& Lambda, const Matrix& K_D, Out more) override;

 private:
  Matrix Lambda_, K_D_;
  std::unique_ptr<Motion> desired_;
  std::unique_ptr<Core> model_;
  bool actual_;
  bool errors(const Measured& at);
  Vector e_, e_dot_, v_, a_, r_;  // there: `slopes` reads them
  Vector product_, turned_, v_model_;
};

// Torques that were measured, by time: each until the next one, or lines between them.
class Torques : public Controller {
 public:
  Torques(Vector times, Matrix tau, bool lines) : times_(std::move(times)), tau_(std::move(tau)), lines_(lines) {}
  bool u(const Measured& at, Out tau, Problem& problem) override;
  bool of_motors() const override { return true; }
  bool needs_terms() const override { return false; }
  bool slopes(Core&, const Indices&, Matrix&, Matrix&) override { return true; }  // none

 private:
  Vector times_;
  Matrix tau_;  // a column a time
  bool lines_;
};

// From u to tau by motor, limited, and back; or from tau to what it does.
class Actuation {
 public:
  struct Gear {
    int joint;
    double turns;  // of the motor by the joint's
  };
  Actuation(const Core& core, std::vector<std::vector<Gear>> gears, bool direct, Allocation allocation);
  void apply(Core& core, Out u, Out tau, Out u_tree);
  void drive(Out tau, Out u_tree) const;  // torques that are asked for
  void clip(Out tau) const { allocation_.clip(tau); }
  const std::vector<std::vector<Gear>> gears;
  const bool direct;  // u is what the motors do
  bool redundant() const { return allocation_.redundant(); }
  bool limited(const Vector& tau, Eigen::Index k) const { return std::abs(tau(k)) >= allocation_.limit(k); }

 private:
  void push(In tau, Out u_tree) const;
  Allocation allocation_;
  Matrix transmission_;
};

// A clock that samples and holds: at k period the state is seen, from k period + delay on what came of it acts.
struct Sampling {
  double period = 0.0, delay = 0.0;
  Vector times;        // the instants, if they are not those
  bool holds = true;   // else what acts has only no derivative there
  long next = 0;       // the number of the next sample
  int taken = 0, acted = 0;  // at the instant that was looked at last: samples, and what came to act
  // A ring of what waits to act, u and when: `first` is the next, `count` how many there are.
  std::vector<std::pair<double, Vector>> ring;
  size_t first = 0, count = 0;

  double near(double t) const { return 1e-9 * period + 1e-15 * t; }  // instants nearer than that are one
  double due() const;      // the next sample
  double instant() const;  // the next one of the clock
  void put(double t, In u);
};

class Control {
 public:
  Control(const Core& core, Actuation actuation);

  std::unique_ptr<Controller> law;  // null: only a constant u acts
  std::optional<Sampling> sampling;
  std::optional<Sensor> sensor;
  std::optional<Drive> drive;
  Vector constant;          // (d), or by motor
  bool constant_of_motors = false;
  Problem problem;
  Vector u, tau, u_tree;            // what acts: (d), (actuators), (n)

  void begin();  // a run begins: nothing was sampled yet
  bool acts() const { return law || !constant.isZero(0); }
  // Let another constant act; false where it is the same.
  bool hold(In value, bool of_motors);
  // Whether the motion has to stay in the coordinates q that u is of: the law, or who steps, looks at terms in them, or
  // eq. 6's force has no other meaning. Torques of motors have one whatever q is.
  bool needs_own_partition() const;
  // Whether what acts between samples takes more of the state than q and q_dot.
  bool needs_terms() const {
    return acts() && ((feedback() && law->needs_terms()) || !(actuation_.direct || of_motors()));
  }
  // Where motors that are not q's own are at limits, as the last `slopes` found them: they do not make u any more.
  struct Clipped {
    bool any = false;
    Matrix answer;       // (motors, d): what those within their limits do to a change of what is wanted of them all
    Vector tau, lambda;  // what they would do without limits, and what holds against that with u on q
    Matrix by_q, by_v;   // (motors, n): how their torques change with the state
  };
  Clipped clipped;
  // d u' / d q' and d u' / d v' where u' was found last; false where that is not known.
  // `force`: what acts, where eq. 6's force is meant as that alone on q.
  bool slopes(Core& core, Matrix& by_q, Matrix& by_v, Vector& force);
  // Whether a motor that is q's own is not at its limit.
  bool answers(Eigen::Index k) const { return !(direct() && limited(k)); }
  bool limited(Eigen::Index k) const { return actuation_.limited(tau, k); }  // a motor
  bool direct() const { return actuation_.direct; }
  bool redundant() const { return actuation_.redundant(); }
  bool of_motors() const { return feedback() ? law->of_motors() : constant_of_motors; }  // what acts is their torques
  // Whether u follows the state between samples.
  bool feedback() const { return law && !(sampling && sampling->holds); }
  bool act(const Measured& at);
  bool sample(const Measured& at, bool& changed);  // at an instant of the clock
  void settle_u(Core& core);  // eq. 6's force of what acts, in q whatever the core's coordinates are
  double lyapunov(const Measured& at, double potential_energy, In w);

 private:
  bool ask(const Measured& at, Out u);
  bool answer(const Measured& at);  // to a sample: sampled_
  bool known(In u);                 // finite
  Measured in_own_q(const Measured& at);
  bool clip(Core& core, Matrix& by_q, Matrix& by_v);  // those slopes
  Actuation actuation_;
  const Indices own_;  // q, whatever the coordinates of the motion are
  Vector sampled_, asked_, pushed_, q_, q_dot_, wanted_;
  Matrix slope_, slope_dot_, to_own_;
};

}  // namespace ckc
