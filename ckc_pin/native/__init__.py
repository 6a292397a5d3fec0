"""The native core: where time advances. A mechanism crosses to C++ as the tables that Python itself evaluates."""

import pinocchio as pin  # first: it loads the libraries that the core is linked with

from ckc_pin.native import _core

__all__ = ["_core"]

if _core.pinocchio_version != pin.__version__:
    raise ImportError(
        f"ckc_pin was compiled against Pinocchio {_core.pinocchio_version}, installed is {pin.__version__}: "
        "install ckc_pin again"
    )
