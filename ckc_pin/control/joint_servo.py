"""P, PI, PD and PID control of single joints by their motors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ckc_pin.base.arrays import Array
from ckc_pin.base.toml import convert
from ckc_pin.base.validation import require_flag, require_type, suggest_name
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.desired import Desired, find_rate_jump, make_motion
from ckc_pin.control.spec import ServoSpec
from ckc_pin.dynamics.terms import Terms
from ckc_pin.errors import InputError
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["JointServo"]


class JointServo:
    """Servos of single joints: the joint's force is x - K_P e - K_D e_dot with the integral x_dot = -K_I e.

    In velocity mode e is the rate minus the desired one, and K_D is zero. While a motor's torque is at its limit, x
    also approaches the value at which the request equals the limit (back-calculation), with the time constant
    ``anti_windup``. Motors without a servo have no torque.

    Parameters
    ----------
    mechanism : Mechanism
    motor : mapping of str to mapping
        Servo of each of some motors, with the keys of a scene's [controller.motor.NAME].
    gravity : bool
        Add the torques that balance h of eq. 6.
    sample_time : float, optional
        Sample time of a sampled servo, s. It is the least time constant of the anti-windup.

    Raises
    ------
    InputError
        An unknown motor, one that drives several joints or none that moves freely, gains that are all zero, a K_D in
        velocity mode, or a desired motion whose rate jumps where K_D or a velocity mode needs it.

    Attributes
    ----------
    desired : Desired
        Of the joints, in the order of the servos.
    balance : Actuation
        The motors that balance h.
    initial_state : (integrals,) array
        Zero: one integral for each servo with K_I.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        motor: Mapping[str, ServoSpec | Mapping[str, Any]],
        *,
        gravity: bool = False,
        sample_time: float | None = None,
    ) -> None:
        require_type(mechanism, Mechanism, "JointServo: mechanism", "a Mechanism, as load returns it")
        require_flag(gravity, "controller.gravity")
        expected = "a table by motor, as {crank = {K_P = 50.0}}"
        require_type(motor, Mapping, "controller.motor", expected)
        if not motor:
            raise InputError(f"controller.motor: expected {expected}, got an empty one")
        specs = {name: _as_spec(name, servo) for name, servo in motor.items()}
        self.mechanism, self.gravity, self.specs = mechanism, gravity, specs
        self.motors = [_find_motor(mechanism, name) for name in specs]
        transmission = mechanism.motors.transmission[self.motors]
        self.joints = [_find_joint(mechanism, name, row) for name, row in zip(specs, transmission, strict=True)]
        self.gear = transmission[range(len(self.joints)), self.joints]
        servos = list(specs.values())
        self.of_rate = np.array([servo.mode == "velocity" for servo in servos])
        self.K_P, self.K_I, self.K_D = (
            np.array([getattr(servo, gain) for servo in servos], dtype=float) for gain in ("K_P", "K_I", "K_D")
        )
        self.unwinding = np.array([_unwinding(servo, sample_time) for servo in servos])
        self.has_integral = self.K_I != 0.0
        self.initial_state = np.zeros(int(self.has_integral.sum()))
        where = [f"controller.motor.{name}.desired" for name in specs]
        self.desired: Desired = make_motion([servo.desired for servo in servos], where)
        jump = find_rate_jump(self.desired, np.inf)
        if jump is not None and (self.K_D.any() or self.of_rate.any()):
            raise InputError(
                f"controller.motor: a desired rate jumps at t = {jump:.6g} s, where the torque would jump too; use "
                'profile = "quintic", "cubic" or "trapezoidal"'
            )
        self._limit = mechanism.motors.torque_limit[:, self.motors]
        self.balance = Actuation(mechanism)

    def tau(self, t: float, terms: Terms, state: Array | None = None) -> Array:
        """Return the motor torques, shape (motors,), before they are limited.

        Parameters
        ----------
        t : float
            s.
        terms : Terms
        state : (integrals,) array, optional
            Default: zero.
        """
        tau = np.zeros(len(self.mechanism.motors.names))
        if self.gravity:
            tau = self.balance.minimum_norm_torques(terms.rho, terms.h)
        e, e_dot = self._errors(t, terms)
        force = -self.K_P * e - np.where(self.of_rate, 0.0, self.K_D * e_dot)
        force[self.has_integral] += self.initial_state if state is None else state
        np.add.at(tau, self.motors, force / self.gear)
        return tau

    def state_dot(self, t: float, terms: Terms, state: Array) -> Array:
        """Return the rates of the integrals, shape (integrals,)."""
        requested = self.tau(t, terms, state)[self.motors]
        excess = requested - np.clip(requested, *self._limit)
        rates = -self.K_I * self._errors(t, terms)[0] - self.unwinding * self.gear * excess
        return np.asarray(rates[self.has_integral])

    @property
    def desired_q(self) -> Desired | None:
        """Desired motion of the independent coordinates; None unless each of them has a servo in position mode."""
        positions = [joint for joint, of_rate in zip(self.joints, self.of_rate, strict=True) if not of_rate]
        if not set(self.mechanism.partition.q) <= set(positions):
            return None
        columns = [self.joints.index(k) for k in self.mechanism.partition.q]

        def desired(t: float) -> tuple[Array, Array, Array]:
            q, q_dot, q_ddot = self.desired(t)
            return q[columns], q_dot[columns], q_ddot[columns]

        return desired

    def limit_torques(self, limit: Array) -> None:
        """Set the lower and upper torque limits that act on the motors, (2, motors), N m or N."""
        self._limit = limit[:, self.motors]

    def servo_tables(self) -> list[dict[str, Any]]:
        """Return the servos for the native core."""
        return [
            {"motor": motor, "joint": joint, "gear": float(self.gear[k]), "of_rate": bool(self.of_rate[k]),
             "K_P": float(self.K_P[k]), "K_I": float(self.K_I[k]), "K_D": float(self.K_D[k]),
             "lower": float(self._limit[0, k]), "upper": float(self._limit[1, k]),
             "unwinding": float(self.unwinding[k])}
            for k, (motor, joint) in enumerate(zip(self.motors, self.joints, strict=True))
        ]  # fmt: skip

    def _errors(self, t: float, terms: Terms) -> tuple[Array, Array]:
        """Return e and, of positions, e_dot, each of shape (servos,)."""
        value, rate, _ = self.desired(t)
        e_dot = terms.v_tree[self.joints] - rate
        position = terms.q_tree[self.mechanism.tree.q_index[self.joints]] - value
        return np.where(self.of_rate, e_dot, position), e_dot


def _as_spec(name: str, servo: ServoSpec | Mapping[str, Any]) -> ServoSpec:
    where = f"controller.motor.{name}"
    if not isinstance(servo, ServoSpec):
        require_type(servo, Mapping, where, "a table with K_P, K_I, K_D and desired")
        servo = convert(dict(servo), ServoSpec, "JointServo", where)
    if not (servo.K_P or servo.K_I or servo.K_D):
        raise InputError(f"{where}: all gains are zero; give K_P, K_I or K_D")
    if servo.mode == "velocity" and servo.K_D:
        raise InputError(f'{where}: K_D belongs to mode = "position"; use K_P and K_I of the rate\'s error')
    if servo.anti_windup is not None and not servo.K_I:
        raise InputError(f"{where}: anti_windup belongs to K_I, which is zero")
    return servo


def _unwinding(servo: ServoSpec, sample_time: float | None) -> float:
    """Return the rate at which the integral approaches what a torque limit admits, 1/s."""
    if not servo.K_I:
        return 0.0
    default = servo.K_P / servo.K_I if servo.K_P else 1.0
    time_constant = max(servo.anti_windup or default, sample_time or 0.0)
    return 1.0 / time_constant


def _find_motor(mechanism: Mechanism, name: str) -> int:
    names = mechanism.motors.names
    if name in names:
        return names.index(name)
    listed = ", ".join(names) or "none"
    raise InputError(f"controller.motor: no motor {name!r}; there are {listed}{suggest_name(name, names)}")


def _find_joint(mechanism: Mechanism, name: str, transmission: Array) -> int:
    joints = np.flatnonzero(transmission)
    if len(joints) != 1:
        driven = ", ".join(mechanism.coordinates[k] for k in joints)
        raise InputError(f"controller.motor.{name}: the motor drives {driven}; a servo needs a motor on one joint")
    joint = int(joints[0])
    if joint in mechanism.prescribed_at:
        raise InputError(
            f"controller.motor.{name}: the motion of {mechanism.coordinates[joint]!r} is prescribed; remove one of them"
        )
    return joint
