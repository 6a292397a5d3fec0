#include "motion/system.hpp"

#include <algorithm>
#include <cmath>

namespace ckc {

constexpr double difference_step = 1.5e-8;  // of forward differences, relative to max(1, |y|)

System::System(Core& core_, Control& control_, int motion_size_)
    : core(core_), control(control_), motion_size(motion_size_), size(motion_size_) {
  law_size_ = control.is_feedback() ? static_cast<int>(control.law->initial_state().size()) : 0, size += law_size_;
  velocity.setZero(core.n), v_tree.setZero(core.n), w.setZero(core.constraints.closure.rows);
  q.setZero(core.d), q_dot.setZero(core.d);
  applied_force_.setZero(core.n), row_correction_.setZero(core.constraints.closure.rows),
      locked_drift_.setZero(core.n), locked_correction_.setZero(core.n);
}

void System::append(Integrand& appended) {
  integrand = &appended, size = coupled_size() + appended.size();
  crosses_singularities = false;  // sensitivities diverge at singular positions
}

void System::integrate_works() {
  work_size_ = work_count, size = coupled_size();
  crosses_singularities = false;  // collocation steps integrate the motion alone
}

void System::start_appended(Out y) {
  Eigen::Index at = motion_size;
  if (law_size_) y.segment(at, law_size_) = control.law->initial_state();
  at += law_size_;
  for (const PrescribedJoint& joint : prescribed_)
    if (joint.can_be_free()) y(at++) = joint.position, y(at++) = joint.rate;
  y.segment(at, work_size_).setZero();
}

double System::next_breakpoint() const {
  return passed_breakpoints_ < breakpoints_.times.size() ? breakpoints_.times(passed_breakpoints_)
                                                         : std::numeric_limits<double>::infinity();
}

void System::start_segment(double t) {
  const double tolerance = breakpoints_.tolerance, *first = breakpoints_.times.data(),
               *last = first + breakpoints_.times.size();
  passed_breakpoints_ = std::upper_bound(first, last, t + tolerance) - first;
  const double begin = passed_breakpoints_ ? breakpoints_.times(passed_breakpoints_ - 1)
                                           : -std::numeric_limits<double>::infinity(),
               end = next_breakpoint();
  if (control.is_feedback()) control.law->set_segment(begin, end, tolerance);
  for (PrescribedJoint& joint : prescribed_) joint.motion->set_segment(begin - joint.from, end - joint.from, tolerance);
  if (forces_) forces_->set_segment(begin, end, tolerance);
  row_time_ = std::numeric_limits<double>::quiet_NaN();
}

// --- prescribed joints ---

bool PrescribedJoint::Switch::is_due(double t, const Indices& occurred) const {
  return time <= t || std::find_first_of(events.begin(), events.end(), occurred.begin(), occurred.end()) != events.end();
}

void System::prescribe(std::vector<PrescribedJoint> joints) {
  prescribed_ = std::move(joints);
  const int rows = core.constraints.closure.rows;
  for (Vector* x : {&core.row_motion.value, &core.row_motion.rate, &lambda_}) x->setZero(rows);
  for (const PrescribedJoint& joint : prescribed_) free_size_ += joint.can_be_free() ? 2 : 0;
  size = coupled_size();
  crosses_singularities &= !free_size_;  // collocation steps integrate the motion alone
}

void System::start_prescribed_joints(In q_tree, In v_tree) {
  breakpoints_ = fixed_breakpoints_;
  for (PrescribedJoint& joint : prescribed_) {
    joint.from = joint.shift = joint.acceleration = 0.0, joint.has_ended = false;
    joint.is_free = joint.begins.exists();
    joint.position = q_tree(core.tree.q_index[joint.coordinate]), joint.rate = v_tree(joint.coordinate);
    set_row(joint);
  }
  if (free_size_) release_free_rows();
}

void System::release_free_rows() {
  Indices rows;
  for (const PrescribedJoint& joint : prescribed_)
    if (joint.is_free) rows.push_back(joint.row);
  core.release_rows(std::move(rows));
  row_time_ = std::numeric_limits<double>::quiet_NaN();
}

void System::set_row(const PrescribedJoint& joint) {
  core.row_motion.value(joint.row) = joint.position - joint.offset;
  core.row_motion.rate(joint.row) = joint.rate;
  // `acceleration` of a free joint is a result, which the core adds itself.
  row_correction_(joint.row) = joint.is_free ? 0.0 : -joint.acceleration;
}

bool System::set_time(double t) {
  if (prescribed_.empty() || t == row_time_) return true;
  for (PrescribedJoint& joint : prescribed_) {
    if (joint.is_free) continue;
    Eigen::Map<Vector> position(&joint.position, 1), rate(&joint.rate, 1), acceleration(&joint.acceleration, 1);
    if (!(*joint.motion)(t - joint.from, position, rate, acceleration)) {
      control.failure.message = joint.motion->failure;
      return fail(RhsFailure::no_control);
    }
    joint.position += joint.shift;
    set_row(joint);
  }
  row_time_ = t, ++row_version_;
  return true;
}

void System::read_free_joints(In y) {
  Eigen::Index at = motion_size + law_size_;
  for (PrescribedJoint& joint : prescribed_) {
    if (!joint.can_be_free()) continue;
    if (joint.is_free && (joint.position != y(at) || joint.rate != y(at + 1))) {
      joint.position = y(at), joint.rate = y(at + 1), ++row_version_;
      set_row(joint);
    }
    at += 2;
  }
}

void System::add_to_free_joints(Out y, In step, int at) const {
  Eigen::Index k = motion_size + law_size_ + at;
  for (const PrescribedJoint& joint : prescribed_) {
    if (joint.is_free) y(k) += step(joint.coordinate);
    if (joint.can_be_free()) k += 2;
  }
}

bool System::switch_prescribed_joints(double t, Out y, const Indices& events) {
  const double due = t + breakpoints_.tolerance;
  Eigen::Index at = motion_size + law_size_;
  for (PrescribedJoint& joint : prescribed_) {
    if (!joint.can_be_free()) continue;
    if (joint.is_free && !joint.has_ended && joint.ends.time > due && joint.begins.is_due(due, events)) {
      if (!sync_core(t, y)) return false;
      write_projected_state(y);
      const double position = joint.position, rate = joint.rate;
      joint.is_free = false, joint.from = t, joint.shift = 0.0;
      release_free_rows();
      if (!set_time(t)) return false;
      joint.shift = position - joint.position;
      row_time_ = std::numeric_limits<double>::quiet_NaN();
      if (!set_time(t) || !add_impulse(joint, joint.rate - rate, y)) return false;
      const Eigen::Index count = breakpoints_.times.size();
      breakpoints_.times.conservativeResize(count + joint.corners.size());
      breakpoints_.times.tail(joint.corners.size()) = joint.corners.array() + t;
      std::sort(breakpoints_.times.data(), breakpoints_.times.data() + breakpoints_.times.size());
    } else if (!joint.is_free && joint.ends.is_due(due, events)) {
      if (!set_time(t)) return false;
      joint.is_free = joint.has_ended = true;
      y(at) = joint.position, y(at + 1) = joint.rate;
      release_free_rows();
    }
    at += 2;
  }
  return true;
}

// The core is at y, with the joint's row already at its new rate.
bool System::add_impulse(PrescribedJoint& joint, double rate_jump, Out y) {
  if (rate_jump == 0.0) return true;
  Vector step(core.n), momentum(core.n);
  const double before = core.energy(velocity, momentum).kinetic;
  if (!core.unit_row_response(joint.row, step)) return fail(RhsFailure::rank_lost);
  step *= rate_jump;
  const double after = core.energy(velocity + step, momentum).kinetic;
  add_velocity(y, step);
  if (work_size_) y(motion_size + law_size_ + free_size_ + int(WorkOf::motors)) += after - before;
  core.joints.locked.clear();  // friction is bounded and has no impulse
  resume(row_time_, y);
  return true;
}

bool System::set_prescribed_torques(double t, Out tau) {
  acceleration_.resize(core.n);
  if (!acceleration(t, acceleration_)) return false;
  force_.value = applied_force(velocity);
  for (size_t i = 0; i < core.joints.locked.size(); ++i)
    force_.value(core.joints.locked[i]) += core.joints.holding_forces()(static_cast<Eigen::Index>(i));
  core.multipliers(force_.value, acceleration_, lambda_);
  for (const PrescribedJoint& joint : prescribed_) {
    if (joint.is_free) continue;
    const double direction = joint.rate > 0.0 ? 1.0 : joint.rate < 0.0 ? -1.0 : 0.0;
    tau(joint.motor) += (lambda_(joint.row) + direction * joint.friction) / joint.gear;
  }
  return lambda_.allFinite();
}

bool System::rhs(double t, In y, Out y_dot) {
  const int works_at = motion_size + law_size_ + free_size_;
  return coupled_rhs(t, y, y_dot) && (!work_size_ || powers(t, y, y_dot.segment(works_at, work_size_))) &&
         (!integrand || integrand->rates(y, y_dot));
}

// The motion, the state of the control law, and free joints.
bool System::coupled_rhs(double t, In y, Out y_dot) {
  if (!set_time(t)) return false;
  read_appended(y);
  if (!motion_rhs(t, y.head(motion_size), y_dot.head(motion_size))) return false;
  Eigen::Index at = motion_size + law_size_;
  for (const PrescribedJoint& joint : prescribed_)
    if (joint.can_be_free())
      y_dot(at++) = joint.is_free ? joint.rate : 0.0, y_dot(at++) = joint.is_free ? joint.acceleration : 0.0;
  return !law_size_ || control.law_rate(measured(t), y_dot.segment(motion_size, law_size_)) ||
         fail(RhsFailure::no_control);
}

// Powers at the state of the last right-hand side.
bool System::powers(double t, In y, Out power) {
  move_core_to_last_rhs(y);
  core.set_velocity(v_tree);
  power.setZero();
  double &motors = power(int(WorkOf::motors)), &friction = power(int(WorkOf::friction));
  motors = control.u_tree.dot(v_tree);
  if (core.springs.has_damping) core.compute_bias(), power(int(WorkOf::dampers)) = core.damping_tree.dot(v_tree);
  if (core.joints.exerts_force()) {
    applied_force_.setZero();
    core.joints.add_friction_force(v_tree, applied_force_);
    friction = applied_force_.dot(v_tree);
  }
  if (forces_) power(int(WorkOf::forces)) = forces_->value.dot(v_tree);
  if (prescribed_.empty()) return true;
  motor_torques_.setZero(control.tau.size());
  if (!set_prescribed_torques(t, motor_torques_)) return false;
  for (const PrescribedJoint& joint : prescribed_) {
    motors += motor_torques_(joint.motor) * joint.gear * joint.rate;
    if (!joint.is_free) friction -= joint.friction * std::abs(joint.rate);
  }
  return true;
}

bool System::jacobian(double t, In y, Matrix& jacobian, long& evaluations) {
  if (!set_time(t)) return false;
  if (law_size_ || free_size_) {
    project_exactly(true);
    const bool exists = difference_jacobian(t, y.head(motion_size + law_size_ + free_size_), jacobian, evaluations);
    project_exactly(false);
    if (!exists) return false;
  } else if (!motion_jacobian(t, y.head(motion_size), jacobian, evaluations)) {
    return false;
  }
  if (!work_size_) return true;
  const Eigen::Index coupled = jacobian.rows();
  jacobian.conservativeResize(coupled + work_size_, coupled + work_size_);
  jacobian.rightCols(work_size_).setZero(), jacobian.bottomRows(work_size_).setZero();
  return true;
}

const Vector& System::applied_force(In v) {
  if (!core.joints.exerts_force() && !forces_) return control.u_tree;
  applied_force_ = control.u_tree;
  if (forces_) applied_force_ += forces_->value;
  core.joints.add_friction_force(v, applied_force_);
  return applied_force_;
}

bool System::acceleration_with_held_joints(In v, In correction, Out a) {
  if (!core.acceleration_with_held_joints(applied_force(v), correction, a)) return fail(RhsFailure::rank_lost);
  for (PrescribedJoint& joint : prescribed_)
    if (joint.is_free) joint.acceleration = a(joint.coordinate);
  return true;
}

bool System::acceleration_derivatives(In q_tree, In v, In correction) {
  eq_1_is_valid_ = false;
  if (!control.is_active() && !forces_ && !core.joints.has_smooth_friction()) {  // nothing depends on the state
    force_.value = control.u_tree;
    force_.by_q.resize(0, 0), force_.by_v.resize(0, 0);
  } else if (!control.derivatives(core, force_.by_q, force_.by_v, force_.value)) {
    return false;
  }
  if (forces_) {
    force_.value += forces_->value;
    if (!forces_->add_derivative(core, force_.by_q)) return false;
  }
  eq_1_is_valid_ = core.acceleration_derivatives(q_tree, v, correction, force_, eq_1_);
  return eq_1_is_valid_ || fail(RhsFailure::rank_lost);
}

bool System::acceleration(double t, Out a) {
  core.set_velocity(velocity);
  return set_time(t) && compute_control(t) && acceleration_with_held_joints(velocity, row_correction_, a);
}

bool System::correct_locked_joints(Out y, double tolerance, bool& changed) {
  Joints& joints = core.joints;
  changed = false;
  core.tree.to_coordinates(core.q_tree, locked_drift_);
  locked_drift_ -= joints.locked_at;
  double max_drift = 0.0, max_rate = 0.0;
  for (int k : joints.locked) {
    max_drift = std::max(max_drift, std::abs(locked_drift_(k)) / joints.table.reach(k));
    max_rate = std::max(max_rate, std::abs(velocity(k)) / joints.table.reach(k));
  }
  if (!(max_drift > tolerance) && !(max_rate > tolerance)) return true;
  if (!core.unit_force_responses(joints.locked, responses_)) return false;
  changed = true;
  joints.compute_correction(responses_, locked_drift_, locked_correction_), add_displacement(y, locked_correction_);
  joints.compute_correction(responses_, velocity, locked_correction_), add_velocity(y, locked_correction_);
  return y.allFinite();
}

double System::phi_z_margin() {
  if (!core.rank) return std::numeric_limits<double>::infinity();
  if (!phi_z_singular_value_) {
    std::vector<Indices> pattern(core.constraints.closure.rows);
    for (size_t i = 0; i < pattern.size(); ++i)
      for (int j : core.constraints.pattern[i])
        if (std::find(core.z.begin(), core.z.end(), j) != core.z.end()) pattern[i].push_back(j);
    phi_z_singular_value_ = std::make_unique<SmallestSingularValue>(std::move(pattern), core.n, core.rank);
  }
  core.compute_J();
  const Vector &rows = core.scales.rows, &columns = core.scales.columns;
  phi_z_singular_value_->compute(core.constraints.J(), rows, columns);
  double square = 0.0;
  const double* entry = core.constraints.J_entries().data();
  for (int i = 0; i < core.constraints.closure.rows; ++i)
    for (int j : core.constraints.pattern[i]) {
      const double scaled = rows(i) * *entry++ * columns(j);
      square += scaled * scaled;
    }
  return phi_z_singular_value_->value() / std::max(std::sqrt(square), 1e-300);
}

bool System::motion_jacobian(double t, In y, Matrix& jacobian, long& evaluations) {
  return difference_jacobian(t, y, jacobian, evaluations);
}

// Derivative of the leading entries of y' with respect to these entries, by forward differences.
bool System::difference_jacobian(double t, In y, Matrix& jacobian, long& evaluations) {
  const auto size = y.size();
  const auto rates = [&](In at, Out y_dot) {
    return size > motion_size ? coupled_rhs(t, at, y_dot) : motion_rhs(t, at, y_dot);
  };
  eq_1_is_valid_ = false;
  jacobian.resize(size, size), moved_rate_.resize(size), rate_at_y_.resize(size);
  moved_y_ = y;
  ++evaluations, ++counts.differences;
  if (!rates(moved_y_, rate_at_y_)) return false;
  for (Eigen::Index k = 0; k < size; ++k) {
    moved_y_(k) = y(k) + difference_step * std::max(1.0, std::abs(y(k)));
    const double step = moved_y_(k) - y(k);
    ++evaluations;
    if (!rates(moved_y_, moved_rate_)) return false;
    jacobian.col(k) = (moved_rate_ - rate_at_y_) / step;
    moved_y_(k) = y(k);
  }
  return jacobian.allFinite();
}

}  // namespace ckc
