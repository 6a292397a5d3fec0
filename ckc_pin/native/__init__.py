"""The C++ core, which integrates the motion. It is built from tables of a mechanism, its controller and its events."""

import pinocchio as pin  # before _core: it loads the libraries that _core is linked with

from ckc_pin.native import _core

EventQuantity = _core.EventQuantity
Loop = _core.Loop
NonDifferentiableReason = _core.NonDifferentiableReason
RhsFailure = _core.RhsFailure
Stop = _core.Stop
StopReason = _core.StopReason

__all__ = ["EventQuantity", "Loop", "NonDifferentiableReason", "RhsFailure", "Stop", "StopReason", "_core"]

if _core.pinocchio_version != pin.__version__:
    raise ImportError(
        f"ckc_pin was compiled against Pinocchio {_core.pinocchio_version}, installed is {pin.__version__}: "
        "install ckc_pin again"
    )
