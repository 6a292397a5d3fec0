"""Settings of the tests of sensitivities."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ckc_pin.codegen import compiler


@pytest.fixture(scope="package", autouse=True)
def quick_compiler() -> Iterator[None]:
    """Compile terms with -O1, which takes half as long and gives the same numbers. tests/codegen uses -O2."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "FLAGS", ("-O1", *compiler.FLAGS[1:]))
        yield
