"""Run pytest with the native core of another build: with_core.py FOLDER ARGUMENTS..."""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pinocchio  # noqa: F401, its libraries are loaded first
import pytest

NAME = "ckc_pin.native._core"


def main() -> int:
    folder, *arguments = sys.argv[1:]
    file = next(Path(folder).glob("_core*.so"))
    spec = spec_from_file_location(NAME, file)
    assert spec is not None
    assert spec.loader is not None
    sys.modules[NAME] = module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return int(pytest.main(arguments))


if __name__ == "__main__":
    sys.exit(main())
