// Forces and moments on bodies, constant, over time, or of the caller's own.
#pragma once

#include <memory>
#include <vector>

#include "control/desired.hpp"
#include "control/measured_state.hpp"

namespace ckc {

// A force and a moment, N and N m.
class WrenchLaw {
 public:
  virtual ~WrenchLaw() = default;
  virtual bool evaluate(const MeasuredState& at, Out wrench, ControlFailure& failure) = 0;
  virtual void set_segment(double /*begin*/, double /*end*/, double /*tolerance*/) {}
  virtual bool depends_on_state() const { return false; }
  // Replace a constant wrench, until the next reset. False if the wrench is no constant.
  virtual bool set(In /*wrench*/) { return false; }
  virtual void reset() {}
};

class ConstantWrench : public WrenchLaw {
 public:
  explicit ConstantWrench(Vector value) : initial_(std::move(value)), value_(initial_) {}
  bool evaluate(const MeasuredState&, Out wrench, ControlFailure&) override { return wrench = value_, true; }
  bool set(In wrench) override { return value_ = wrench, true; }
  void reset() override { value_ = initial_; }

 private:
  const Vector initial_;
  Vector value_;
};

// A wrench that is a function of time.
class WrenchOverTime : public WrenchLaw {
 public:
  explicit WrenchOverTime(std::unique_ptr<Trajectory> values) : values_(std::move(values)), rate_(6), acceleration_(6) {}
  bool evaluate(const MeasuredState& at, Out wrench, ControlFailure& failure) override {
    if ((*values_)(at.t, wrench, rate_, acceleration_)) return true;
    return failure.message = values_->failure, false;
  }
  void set_segment(double begin, double end, double tolerance) override {
    values_->set_segment(begin, end, tolerance);
  }

 private:
  std::unique_ptr<Trajectory> values_;
  Vector rate_, acceleration_;
};

// A wrench on a body, at the origin of a frame of that body.
struct BodyForce {
  int joint;       // that moves the body
  Vector3 origin;  // of the frame, in the joint's axes
  Matrix3 axes;    // of the frame, in the joint's axes
  bool in_world;   // whether the wrench is given in the world's axes, not in the frame's
  std::unique_ptr<WrenchLaw> wrench;
};

class BodyForces {
 public:
  BodyForces(std::vector<BodyForce> forces, int n);
  // Compute `value` at the core's state. False if a wrench does not exist.
  bool compute(const MeasuredState& at, ControlFailure& failure);
  void set_segment(double begin, double end, double tolerance);
  // Replace the wrench of a force, until the next reset. False if it is no constant.
  bool set(size_t k, In wrench) { return forces_[k].wrench->set(wrench); }
  void reset();
  // Add the derivative of `value` with respect to q' (tangent), (n, n). False if a wrench depends on the state,
  // because its derivative is unknown.
  bool add_derivative(Core& core, Matrix& by_q) const;
  Vector value;     // generalized force on the tree, (n)
  Vector wrenches;  // force and moment of each force, in its axes, (6 count)

 private:
  // The wrench in world axes, with the moment about the world's origin; and the frame's origin.
  Vector6 in_world_axes(const Tree& tree, size_t k, Vector3& origin) const;
  std::vector<BodyForce> forces_;
};

}  // namespace ckc
