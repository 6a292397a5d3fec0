"""The native core: the same numbers, an order of magnitude sooner, where it was built.

The Python rooms below are the reference and the fallback; here a mechanism crosses to C++ as the tables that they
use themselves. `unavailable` says why the core cannot be used, None where it can.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

import pinocchio as pin  # first: it loads the libraries that the core is linked with

__all__ = ["core", "unavailable"]


@cache
def _load() -> tuple[Any, str | None]:
    try:
        module = import_module("ckc_pin.native._core")
    except ModuleNotFoundError:
        return None, "the native core was not built: no C++ compiler was found when ckc_pin was installed"
    except ImportError as error:
        return None, f"the native core does not load: {error}"
    if module.pinocchio_version != pin.__version__:
        return None, (
            f"the native core was compiled against Pinocchio {module.pinocchio_version}, installed is "
            f"{pin.__version__}: install ckc_pin again"
        )
    return module, None


def unavailable() -> str | None:
    """Say in half a sentence why there is no native core here; None when there is."""
    return _load()[1]


def core() -> Any:
    """Return the compiled module; only where `unavailable` says None."""
    return _load()[0]
