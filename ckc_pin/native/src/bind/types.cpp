// Bindings of enums and of the structs that describe a run.
#include <nanobind/stl/optional.h>

#include "bind/run.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

void bind_enums(nb::module_& m) {
  nb::enum_<Stop::Reason>(m, "StopReason", "Why the loop stopped.")
      .value("END", Stop::end, "the requested time is reached")
      .value("EVENT", Stop::event, "a stopping event occurred")
      .value("PAUSE", Stop::pause, "the interpreter should run")
      .value("RHS_BUDGET", Stop::rhs_budget, "the budget of right-hand sides is used up")
      .value("WALL_BUDGET", Stop::wall_budget, "the budget of time is used up")
      .value("PACE", Stop::pace, "the remaining motion would take too many right-hand sides")
      .value("MIN_STEP", Stop::min_step, "the step size fell below its minimum")
      .value("STEP", Stop::step, "no step can be made, see StepFailure")
      .value("RANK", Stop::rank, "J loses rank, and the position cannot be crossed")
      .value("COORDINATES_SINGULAR", Stop::coordinates_singular, "phi_z is singular: q does not determine z")
      .value("ENERGY", Stop::energy, "the energy of a conservative motion changes, however short the step")
      .value("CONTROL", Stop::control, "the controller has no u")
      .value("EVENT_FUNCTION", Stop::event_function, "an event's function has no finite value")
      .value("OUTPUT", Stop::output, "the state cannot be recorded")
      .value("CHATTER", Stop::chatter, "joint modes change again and again at one instant")
      .value("CONTACT_UNSOLVED", Stop::contact_unsolved, "no contact forces or impulses exist")
      .value("BEYOND_STOP", Stop::beyond_stop, "a joint has passed its stop")
      .value("EXCEPTION", Stop::exception, "a callback raised an exception");
  nb::enum_<RhsFailure>(m, "RhsFailure", "Why a right-hand side does not exist.")
      .value("NONE", RhsFailure::none)
      .value("LOOPS_OPEN", RhsFailure::loops_open, "the projection onto the constraint manifold failed")
      .value("RANK_LOST", RhsFailure::rank_lost, "J has lost rank")
      .value("NOT_FINITE", RhsFailure::not_finite, "a number is not finite")
      .value("NO_CONTROL", RhsFailure::no_control, "the controller has no u")
      .value("Z_INACCURATE", RhsFailure::z_inaccurate, "z does not agree with its rates")
      .value("ALLOCATION_NOT_DIFFERENTIABLE", RhsFailure::allocation_not_differentiable)
      .value("TORQUE_POLE", RhsFailure::torque_pole, "a motor jumps from one limit to the other");
  nb::enum_<JointTransition::Kind>(m, "JointTransitionKind", "A transition between joint modes.")
      .value("STICKS", JointTransition::sticks)
      .value("SLIDES", JointTransition::slides)
      .value("TOUCHES", JointTransition::touches)
      .value("LEAVES", JointTransition::leaves)
      .value("BOUNCES", JointTransition::bounces);
  nb::enum_<Event::Quantity>(m, "EventQuantity", "The quantity whose zero crossing is an event.")
      .value("Q", Event::q)
      .value("Q_DOT", Event::q_dot)
      .value("SIGMA_MIN_PHI_Z", Event::sigma_min_phi_z)
      .value("SIGMA_MIN_J", Event::sigma_min_J)
      .value("FUNCTION", Event::function);
  nb::enum_<NonDifferentiableEvent::Reason>(m, "NonDifferentiableReason")
      .value("TIME", NonDifferentiableEvent::time, "simultaneous events move to different times")
      .value("RESTITUTION", NonDifferentiableEvent::restitution, "stops with different restitution reflect at once")
      .value("MARGINALLY_LOCKED", NonDifferentiableEvent::marginally_locked, "a holding force is at its bound");
  nb::enum_<Core::Parameter>(m, "CoreParameter", "Kinds of parameters of a core.")
      .value("GRAVITY", Core::Parameter::gravity)
      .value("OFFSET", Core::Parameter::offset)
      .value("MASS", Core::Parameter::mass)
      .value("CENTRE", Core::Parameter::centre)
      .value("INERTIA", Core::Parameter::inertia)
      .value("ARMATURE", Core::Parameter::armature)
      .value("ROTORS", Core::Parameter::rotors)
      .value("POINT", Core::Parameter::point)
      .value("LENGTH", Core::Parameter::length)
      .value("AFFINE", Core::Parameter::affine)
      .value("AFFINE_OFFSET", Core::Parameter::affine_offset)
      .value("END", Core::Parameter::end)
      .value("STIFFNESS", Core::Parameter::stiffness)
      .value("REST_LENGTH", Core::Parameter::rest_length)
      .value("DAMPING", Core::Parameter::damping)
      .value("JOINT_STIFFNESS", Core::Parameter::joint_stiffness)
      .value("JOINT_REST", Core::Parameter::joint_rest)
      .value("JOINT_DAMPING", Core::Parameter::joint_damping)
      .value("CONSTANT", Core::Parameter::constant)
      .value("COMPILED", Core::Parameter::compiled, "the parameters of the compiled terms");
  using Kind = ParameterDerivative;
  nb::enum_<Kind::Kind>(m, "ParameterDerivativeKind", "The quantity that depends on a parameter.")
      .value("PLACEMENT", Kind::placement)
      .value("INERTIA", Kind::inertia)
      .value("GRAVITY", Kind::gravity)
      .value("STIFFNESS", Kind::stiffness)
      .value("REST_LENGTH", Kind::rest_length)
      .value("DAMPING", Kind::damping)
      .value("JOINT_STIFFNESS", Kind::joint_stiffness)
      .value("JOINT_REST", Kind::joint_rest)
      .value("JOINT_DAMPING", Kind::joint_damping)
      .value("CONSTANT", Kind::constant)
      .value("FRICTION", Kind::friction)
      .value("RESTITUTION", Kind::restitution)
      .value("LOWER", Kind::lower)
      .value("UPPER", Kind::upper)
      .value("ARMATURE", Kind::armature)
      .value("ROTORS", Kind::rotors)
      .value("LENGTH", Kind::length)
      .value("OFFSET", Kind::offset)
      .value("COEFFICIENT", Kind::coefficient)
      .value("GAIN_Q", Kind::gain_q)
      .value("GAIN_Q_DOT", Kind::gain_q_dot)
      .value("TARGET", Kind::target)
      .value("GEAR", Kind::gear)
      .value("TORQUE_LIMIT", Kind::torque_limit);
}

nb::typed<nb::dict, nb::str, nb::any> stats_to_dict(const LoopStats& stats) {
  nb::typed<nb::dict, nb::str, nb::any> table;
  table["terms"] = stats.terms, table["rhs_by_terms"] = stats.rhs_by_terms;
  table["rhs"] = stats.rhs, table["steps"] = stats.steps, table["rejected"] = stats.rejected;
  table["newton"] = stats.newton, table["factorizations"] = stats.factorizations;
  table["jacobians"] = stats.jacobians, table["differences"] = stats.differences, table["switches"] = stats.switches;
  table["method"] = stats.method, table["steps_by_method"] = stats.steps_by_method;
  table["python_calls"] = stats.python_calls;
  return table;
}

}  // namespace

void bind_types(nb::module_& m) {
  bind_enums(m);
  nb::class_<Stop>(m, "Stop", "Why and when the loop stopped.")
      .def_ro("reason", &Stop::reason)
      .def_ro("t", &Stop::t)
      .def_ro("value", &Stop::value, "smallest singular value, right-hand sides, or value of a function")
      .def_ro("which", &Stop::which, "event or coordinate, else -1");
  nb::class_<StepFailure>(m, "StepFailure", "Why no step could be made.")
      .def_ro("reason", &StepFailure::reason)
      .def_ro("message", &StepFailure::message, "of the controller")
      .def_ro("u", &StepFailure::u, "of the controller, if it is not finite")
      .def_ro("sigma_min", &StepFailure::sigma_min, "smallest singular value of phi_z")
      .def_ro("margin", &StepFailure::margin, "sigma_min over the norm of J")
      .def_ro("q_tree", &StepFailure::q_tree)
      .def_ro("q", &StepFailure::q)
      .def_ro("z", &StepFailure::z);
  nb::class_<EventTable>(m, "Event", "An event: a quantity crosses a value.")
      .def(
          "__init__",
          [](EventTable* self, Event::Quantity quantity, int coordinate, double value, double sign, int direction,
             bool stop, double zero_threshold, nb::object function) {
            Event event;
            event.quantity = quantity, event.coordinate = coordinate, event.value = value, event.sign = sign;
            event.direction = direction, event.stop = stop, event.zero_threshold = zero_threshold;
            new (self) EventTable{std::move(event), std::move(function)};
          },
          nb::kw_only(), "quantity"_a, "coordinate"_a = 0, "value"_a = 0.0, "sign"_a = 1.0, "direction"_a = 0,
          "stop"_a = false, "zero_threshold"_a = 0.0, "function"_a.none() = nb::none())
      .def_prop_ro("quantity", [](const EventTable& table) { return table.event.quantity; })
      .def_prop_ro("coordinate", [](const EventTable& table) { return table.event.coordinate; })
      .def_prop_ro("stop", [](const EventTable& table) { return table.event.stop; });
  nb::class_<EventOccurrence>(m, "EventOccurrence", "The occurrence of an event.")
      .def_ro("t", &EventOccurrence::t)
      .def_ro("event", &EventOccurrence::event, "index of the event")
      .def_ro("direction", &EventOccurrence::direction, "1: rising, -1: falling");
  nb::class_<JointTransition>(m, "JointTransition", "A transition of a joint's mode.")
      .def_ro("t", &JointTransition::t)
      .def_ro("coordinate", &JointTransition::coordinate)
      .def_ro("kind", &JointTransition::kind)
      .def_ro("direction", &JointTransition::direction, "of the motion, or of the stop: -1 for the lower one");
  nb::class_<LockedJoint>(m, "LockedJoint", "A joint that sticks or is at a stop.")
      .def_ro("coordinate", &LockedJoint::coordinate)
      .def_ro("force", &LockedJoint::force, "N or N m")
      .def_ro("lower", &LockedJoint::lower, "bound of the force")
      .def_ro("upper", &LockedJoint::upper, "bound of the force");
  nb::class_<LoopStats>(m, "LoopStats", "Counters of a run.")
      .def_ro("terms", &LoopStats::terms)
      .def_ro("method", &LoopStats::method)
      .def_ro("rhs", &LoopStats::rhs)
      .def_ro("steps", &LoopStats::steps)
      .def_ro("rejected", &LoopStats::rejected)
      .def_ro("newton", &LoopStats::newton)
      .def_ro("factorizations", &LoopStats::factorizations)
      .def_ro("jacobians", &LoopStats::jacobians)
      .def_ro("differences", &LoopStats::differences, "Jacobians by finite differences")
      .def_ro("switches", &LoopStats::switches, "changes of the partition")
      .def_ro("python_calls", &LoopStats::python_calls)
      .def_ro("steps_by_method", &LoopStats::steps_by_method)
      .def_ro("rhs_by_terms", &LoopStats::rhs_by_terms)
      .def("to_dict", &stats_to_dict, "Return the counters by the names of a run's `stats`.");
  nb::class_<RecordColumns>(m, "RecordColumns", "Where a quantity is in a row of the record.")
      .def_ro("name", &RecordColumns::name)
      .def_ro("begin", &RecordColumns::begin)
      .def_ro("end", &RecordColumns::end);
  nb::class_<NonDifferentiableEvent>(m, "NonDifferentiableEvent", "Why a motion is not differentiable from here on.")
      .def_prop_ro("coordinate", [](const NonDifferentiableEvent& event) { return event.arrival.coordinate; })
      .def_prop_ro(
          "of_rate", [](const NonDifferentiableEvent& event) { return event.arrival.of_rate; },
          "whether its rate arrives at zero")
      .def_ro("parameter", &NonDifferentiableEvent::parameter, "index of the parameter")
      .def_ro("reason", &NonDifferentiableEvent::reason);
}

}  // namespace ckc
