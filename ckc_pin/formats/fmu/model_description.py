"""The file modelDescription.xml of an FMU, and the units in it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from ckc_pin.formats.fmu.variables import Variable

__all__ = ["build_description", "describe_model"]

BASE_UNITS = {"N": {"kg": 1, "m": 1, "s": -2}, "J": {"kg": 1, "m": 2, "s": -2}}
EXPONENTS = {"²": 2}
IDENTIFIER = r"[A-Za-z_][A-Za-z0-9_]*"
STRUCTURED_NAME = re.compile(rf"{IDENTIFIER}(\.{IDENTIFIER})*")
FLAGS = {
    "2.0": "canGetAndSetFMUstate canSerializeFMUstate providesDirectionalDerivative",
    "3.0": "canGetAndSetFMUState canSerializeFMUState providesDirectionalDerivatives",
}


def describe_model(
    fmi: str,
    name: str,
    identifier: str,
    identity: str,
    tool: str,
    variables: Sequence[Variable],
    experiment: dict[str, str],
    source: str,
) -> str:
    """Return the model description.

    Parameters
    ----------
    fmi : str
        "2.0" or "3.0".
    name : str
    identifier : str
        Name of the shared library.
    identity : str
        GUID, or instantiation token, which the C code knows.
    tool : str
        Program and version that writes it.
    variables : sequence of Variable
    experiment : dict
        Attributes of the default experiment.
    source : str
        Name of the file to compile.
    """
    is_old = fmi == "2.0"
    is_structured = all(STRUCTURED_NAME.fullmatch(x.name) for x in variables)
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": fmi,
            "modelName": name,
            "guid" if is_old else "instantiationToken": identity,
            "generationTool": tool,
            "variableNamingConvention": "structured" if is_structured else "flat",
        },
    )
    if is_old:
        root.set("numberOfEventIndicators", str(sum(x.is_event_indicator for x in variables)))
    for kind in ("ModelExchange", "CoSimulation"):
        interface = SubElement(root, kind, {"modelIdentifier": identifier})
        for flag in FLAGS[fmi].split():
            interface.set(flag, "true")
        if kind == "CoSimulation":
            interface.set("canHandleVariableCommunicationStepSize", "true")
        if is_old:
            SubElement(SubElement(interface, "SourceFiles"), "File", {"name": source})
    _add_units(root, variables)
    SubElement(root, "DefaultExperiment", {"startTime": "0.0", **experiment})
    (_add_scalar_variables if is_old else _add_variables)(root, variables)
    _add_structure(root, variables, is_old)
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def build_description(identifier: str, source: str) -> str:
    """Return the file buildDescription.xml of FMI 3.0."""
    root = Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    configuration = SubElement(root, "BuildConfiguration", {"modelIdentifier": identifier})
    files = SubElement(configuration, "SourceFileSet", {"language": "C99"})
    SubElement(files, "SourceFile", {"name": source})
    SubElement(configuration, "Library", {"name": "m"})
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_units(root: Element, variables: Sequence[Variable]) -> None:
    units = SubElement(root, "UnitDefinitions")
    for unit in sorted({x.unit for x in variables} - {""}):
        base = {name: str(exponent) for name, exponent in _base_exponents(unit).items() if exponent}
        SubElement(SubElement(units, "Unit", {"name": unit}), "BaseUnit", base)


def _base_exponents(unit: str) -> Counter[str]:
    """Return the exponents of a unit's base units: of "N m s/rad", kg 1, m 2, s -1, rad -1."""
    exponents: Counter[str] = Counter()
    for sign, part in zip((1, -1), unit.split("/"), strict=False):
        for factor in part.split():
            power = EXPONENTS.get(factor[-1], 1)
            symbol = factor.rstrip("".join(EXPONENTS))
            for base, exponent in BASE_UNITS.get(symbol, {symbol: 1}).items():
                exponents[base] += sign * power * exponent
    return exponents


def _attributes(variable: Variable) -> dict[str, str]:
    attributes = {
        "name": variable.name,
        "valueReference": str(variable.reference),
        "description": variable.description,
        "causality": variable.causality,
        "variability": variable.variability,
        "initial": variable.initial if variable.causality == "output" else "",  # the others have it by default
    }
    return {key: text for key, text in attributes.items() if text}


def _value_attributes(variable: Variable) -> dict[str, str]:
    attributes = {"unit": variable.unit, "start": "" if variable.start is None else repr(variable.start)}
    return {key: text for key, text in attributes.items() if text}


def _add_scalar_variables(root: Element, variables: Sequence[Variable]) -> None:
    index, parent = _indices(variables), SubElement(root, "ModelVariables")
    for variable in variables:
        real = SubElement(
            SubElement(parent, "ScalarVariable", _attributes(variable)), "Real", _value_attributes(variable)
        )
        if variable.derivative_of is not None:
            real.set("derivative", index[variable.derivative_of])


def _add_variables(root: Element, variables: Sequence[Variable]) -> None:
    parent = SubElement(root, "ModelVariables")
    for variable in variables:
        element = SubElement(parent, "Float64", _attributes(variable) | _value_attributes(variable))
        if variable.derivative_of is not None:
            element.set("derivative", str(variable.derivative_of))


def _add_structure(root: Element, variables: Sequence[Variable], is_old: bool) -> None:
    """Add the lists of outputs, of derivatives and of outputs without a start value, by index or by value reference."""
    structure, index = SubElement(root, "ModelStructure"), _indices(variables)
    outputs = [x for x in variables if x.causality == "output"]
    groups = {
        ("Outputs", "Output"): outputs,
        ("Derivatives", "ContinuousStateDerivative"): [x for x in variables if x.derivative_of is not None],
        ("InitialUnknowns", "InitialUnknown"): [x for x in outputs if x.initial == "calculated"],
    }
    for (old, new), members in groups.items():
        parent = SubElement(structure, old) if is_old else structure
        for variable in members:
            if is_old:
                SubElement(parent, "Unknown", {"index": index[variable.reference]})
            else:
                SubElement(parent, new, {"valueReference": str(variable.reference)})
    for variable in variables:
        if variable.is_event_indicator and not is_old:
            SubElement(structure, "EventIndicator", {"valueReference": str(variable.reference)})


def _indices(variables: Sequence[Variable]) -> dict[int, str]:
    """Return the places of variables in the file, from 1, by value reference."""
    return {variable.reference: str(k) for k, variable in enumerate(variables, 1)}
