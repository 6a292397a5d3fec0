"""Parse the YAML files beside a URDF, which are untrusted.

msgspec parses them with PyYAML's safe loader. Deep nesting overflows the stack of PyYAML's C parser, and aliases
multiply the size of the content. Both are refused before parsing.
"""

from __future__ import annotations

import re
from itertools import accumulate
from typing import TypeVar

import msgspec

from ckc_pin.base.toml import convert
from ckc_pin.errors import InputError

__all__ = ["parse_yaml"]

T = TypeVar("T", bound=msgspec.Struct)
MAX_CHARACTERS = 2**16  # the largest published file has 2500
MAX_DEPTH = 20  # levels of nested values
NESTED_ON_ONE_LINE = re.compile(r"([-?:][ \t]+){20}")  # "- - - ..." nests a level with each dash
ALIAS = re.compile(r"(^|[\s\[{,:-])[&*]\w", re.MULTILINE)


def parse_yaml(text: str, kind: type[T], source: str) -> tuple[T, list[str]]:
    """Return a file's content, and the keys that the structure does not have."""
    if len(text) > MAX_CHARACTERS:
        raise InputError(f"{source}: more than {MAX_CHARACTERS} characters, too large for such a file")
    depth = max(accumulate((c in "[{") - (c in "]}") for c in text), default=0)
    if depth > MAX_DEPTH or NESTED_ON_ONE_LINE.search(text):
        raise InputError(f"{source}: values nested more than {MAX_DEPTH} deep are not accepted")
    if ALIAS.search(text):
        raise InputError(f"{source}: YAML anchors and aliases (&name, *name) are not accepted")
    try:
        content = msgspec.yaml.decode(text)
    except ImportError:
        raise InputError(f"{source}: reading it needs PyYAML; install it with `pip install pyyaml`") from None
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise InputError(f"{source}: malformed YAML: {' '.join(str(error).split())}") from None
    fields = [field.name for field in msgspec.structs.fields(kind)]
    if not isinstance(content, dict):
        raise InputError(f"{source}: expected a table with keys such as {', '.join(fields)}")
    return convert(content, kind, source), [str(key) for key in content if key not in fields]
