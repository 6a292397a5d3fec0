"""Whether a scene's controller is stable about its target, or along its desired motion; and which K_P would do."""

from __future__ import annotations

from ckc_pin.base.linear_algebra import one_blas_thread
from ckc_pin.codegen.library import Library
from ckc_pin.control.actuation import Actuation
from ckc_pin.control.controllers import SetPoint, Tracking
from ckc_pin.errors import NumericalError
from ckc_pin.linear.closed_loop import ClosedLoop
from ckc_pin.linear.limited_closed_loop import LoopWithinLimits
from ckc_pin.linear.sampled_loop import MOST_DELAYED, MOST_SAMPLES
from ckc_pin.linear.set_point_stability import set_point_stability
from ckc_pin.linear.stability_result import Stability
from ckc_pin.linear.tracking_stability import tracking_stability
from ckc_pin.mechanism.configuration import Kinematics
from ckc_pin.mechanism.mechanism import Mechanism

__all__ = ["stability"]


def stability(
    mechanism: Mechanism,
    law: SetPoint | Tracking,
    t_end: float,
    smoothing: float | None = None,
    sampling: tuple[float, float] | None = None,
    library: Library | None = None,
    near: Kinematics | None = None,
    actuation: Actuation | None = None,
) -> Stability:
    """Linearize a controller's closed loop.

    Parameters
    ----------
    t_end : float
        How long a desired motion lasts, s.
    smoothing : float, optional
        A scene's friction_smoothing.
    sampling : (sample_time, delay), optional
        s; the verdict is then that of the sampled loop.
    library : Library, optional
        The mechanism's terms, compiled.
    near : Kinematics, optional
        Where a run starts: target and motion are meant on its assembly branch; default: as assembled.
    actuation : Actuation, optional
        Whose limits have to leave what holds the target, or the motion.
    """
    import scipy.linalg  # noqa: F401  (with its BLAS, before that is kept on one thread)

    with one_blas_thread():
        try:
            _require_countable(law, t_end, sampling)
            closed_loop = ClosedLoop(mechanism, law, smoothing, library)
            loop = LoopWithinLimits(mechanism, law, closed_loop, smoothing, actuation)
            near = near or mechanism.assembled
            if isinstance(law, SetPoint):
                return set_point_stability(law, loop, near, sampling)
            return tracking_stability(law, loop, near, t_end, sampling)
        except NumericalError as error:
            return Stability(None, str(error))


def _require_countable(law: SetPoint | Tracking, t_end: float, sampling: tuple[float, float] | None) -> None:
    if sampling is None:
        return
    sample_time, delay = sampling
    if delay > MOST_DELAYED * sample_time:
        raise NumericalError(
            f"controller.delay lasts {delay / sample_time:.6g} samples; what is under way is followed for "
            f"{MOST_DELAYED} at most"
        )
    if isinstance(law, Tracking) and t_end > MOST_SAMPLES * sample_time:
        raise NumericalError(
            f"the motion has {t_end / sample_time:.6g} samples; at most {MOST_SAMPLES} are gone through: "
            "a shorter t_end has a verdict"
        )
