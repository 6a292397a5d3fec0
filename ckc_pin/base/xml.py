"""XML from strangers: parsed by expat without recovery, document types and with them entities refused."""

from __future__ import annotations

from xml.etree import ElementTree
from xml.parsers import expat

from ckc_pin.errors import InputError

__all__ = ["MAX_DEPTH", "strict_xml"]

MAX_DEPTH = 300  # of nested elements; ElementTree writes by recursion


def strict_xml(text: str, source: str) -> ElementTree.Element:
    """Parse XML from a stranger: no recovery, no document type, hence no entities, no abyss of nested elements.

    Raises
    ------
    InputError
        With the line, where expat has one.
    """
    depth = 0

    def refuse(name: str, *_: object) -> None:
        raise InputError(f"{source}: a document type declaration ({name}) is not accepted")

    def enter(*_: object) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH:
            raise InputError(f"{source}: elements nested more than {MAX_DEPTH} deep are not accepted")

    def leave(_: str) -> None:
        nonlocal depth
        depth -= 1

    # The text is UTF-8, or it would not have been read, whatever its first line says.
    checker = expat.ParserCreate("utf-8")
    checker.StartDoctypeDeclHandler = refuse
    checker.StartElementHandler, checker.EndElementHandler = enter, leave
    try:
        checker.Parse(text.encode(), True)
        return ElementTree.fromstring(text.encode(), ElementTree.XMLParser(encoding="utf-8"))
    except (expat.ExpatError, ElementTree.ParseError) as error:
        raise InputError(f"{source}: malformed XML: {error}") from None
