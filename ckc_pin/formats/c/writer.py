"""C99 sources of one mechanism: its compiled terms, and templates of what is the same for all mechanisms."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ckc_pin.base.linear_algebra import MIN_PIVOT
from ckc_pin.codegen.arguments import argument_names, argument_units, present, values
from ckc_pin.codegen.c_source import count_operations, write_static_function
from ckc_pin.codegen.comparison import TERMS_TOLERANCE
from ckc_pin.codegen.library import explain_too_large
from ckc_pin.codegen.term_functions import TermFunctions
from ckc_pin.errors import InputError
from ckc_pin.formats.c.names import comment, identifiers, initializer, table
from ckc_pin.formats.c.vectors import QUANTITIES, write_vectors
from ckc_pin.kinematics.continuation import MAX_NEWTON_STEP
from ckc_pin.kinematics.sigma import MAX_ITERATIONS
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import model_numbers
from ckc_pin.mechanism.tree import LARGE_COORDINATE, MAX_TOLERANCE_FACTOR

__all__ = ["TEMPLATES", "fill_templates", "make_prefix", "require_exportable", "to_c"]

TEMPLATES = Path(__file__).parent / "templates"  # `mech` and `MECH` in names and texts are replaced by the prefix
FRAME_BYTES = 256  # of a call: return address, saved registers, parameters, loop counters
# Names of headers of C99, of `main.c`, of CMake's targets and of an FMU's sources, which a prefix must not take.
RESERVED_PREFIXES = {
    "assert", "complex", "ctype", "errno", "fenv", "float", "inttypes", "iso646", "limits", "locale", "math", "setjmp",
    "signal", "stdarg", "stdbool", "stddef", "stdint", "stdio", "stdlib", "string", "tgmath", "time", "wchar", "wctype",
    "features", "main", "all", "clean", "help", "install", "package", "test", "c", "m", "t",
    "fmu", "fmi2", "fmi3", "stops", "directional_derivatives", "co_simulation",
}  # fmt: skip


def to_c(mechanism: Mechanism, stem: str) -> tuple[dict[str, str], list[str]]:
    """Return C99 sources of a mechanism by file name, and notes on what they leave out.

    Parameters
    ----------
    mechanism : Mechanism
    stem : str
        Name from which the prefix of files and functions is made.

    Raises
    ------
    InputError
        A part of the mechanism is not supported in C, it is too large for compiled terms, or CasADi is missing.
    """
    require_exportable(mechanism, f"{mechanism.name}: export to c")
    texts = {path.name: path.read_text(encoding="ascii") for path in sorted(TEMPLATES.iterdir())}
    texts["mech_vectors.h"] = write_vectors(mechanism)
    return fill_templates(mechanism, make_prefix(stem), texts), _omissions(mechanism)


def fill_templates(
    mechanism: Mechanism,
    prefix: str,
    texts: Mapping[str, str],
    more: Mapping[str, str] | None = None,
    derivatives: bool = False,
) -> dict[str, str]:
    """Return templates by file name with a mechanism's code, sizes and names.

    Parameters
    ----------
    mechanism : Mechanism
    prefix : str
        Replaces `mech` in names of files and functions.
    texts : mapping
    more : mapping, optional
        Further texts, which replace ``@KEY@``.
    derivatives : bool
        Whether the code has directional derivatives of the terms.
    """
    functions = TermFunctions.of(mechanism, portable=True, directional_derivatives=derivatives).functions
    enumerators = _enumerators(mechanism, prefix)
    substitutions = {
        **_sizes(mechanism, functions),
        **_places(enumerators),
        **_parameters(mechanism),
        "TITLE": comment(mechanism.name),
        "VERSION": version("ckc_pin"),
        "COORDINATES": _describe_coordinates(mechanism, enumerators),
        "TABLES": _name(_tables(mechanism), prefix),
        "FUNCTIONS": "\n".join(write_static_function(f, f"code_{name}") for name, f in functions.items()),
        "STACK": str(_stack_bytes(mechanism, functions)),
        "MAX_ITERATIONS": str(MAX_ITERATIONS),
        "MAX_STEP": repr(MAX_NEWTON_STEP),
        "TOLERANCE": repr(float(mechanism.tolerance)),
        "SMALLEST_PIVOT": repr(MIN_PIVOT),
        "LARGE_COORDINATE": repr(LARGE_COORDINATE),
        "MAX_TOLERANCE_FACTOR": repr(MAX_TOLERANCE_FACTOR),
        "STEP": repr(float(mechanism.tree.step_scale[mechanism.partition.q].min())),
        "QUANTITY_NAMES": ", ".join(f'"{name}"' for name in QUANTITIES),
        "TEST_TOLERANCE": repr(TERMS_TOLERANCE),
        **(more or {}),
    }
    files = {_name(file, prefix): _name(text, prefix) for file, text in texts.items()}
    for key, text in substitutions.items():
        files = {file: content.replace(f"@{key}@", text) for file, content in files.items()}
    return files


def require_exportable(mechanism: Mechanism, where: str) -> None:
    """Raise InputError for parts of a mechanism that would move differently in the C code."""
    mechanism.refuse_prescribed_joints(where)
    if reason := explain_too_large(mechanism):
        raise InputError(f"{where}: {reason}")
    rough = [mechanism.coordinates[k] for k in np.flatnonzero(mechanism.joints.friction)]
    if rough:
        raise InputError(
            f"{where}: dry friction of {', '.join(rough)} is not supported, since sticking needs events; set "
            f"friction = 0 (--set joint.{rough[0]}.friction=0), and add friction as a force outside of the code"
        )
    if mechanism.d == 0:
        raise InputError(f"{where}: the mechanism has no freedom, so there is nothing to control")
    if roots := mechanism.independent_root_coordinates:
        raise InputError(
            f"{where}: independent coordinates of a free root ({', '.join(roots)}) are not supported; name joints as "
            "independent, if the loops allow it"
        )


def _omissions(mechanism: Mechanism) -> list[str]:
    stopped = [mechanism.coordinates[k] for k in np.flatnonzero(mechanism.joints.stopped)]
    motors, has_limits = mechanism.motors, bool(np.isfinite(mechanism.motors.torque_limit).any())
    notes = []
    if stopped:
        notes.append(f"stops of {', '.join(stopped)} are left out")
    if len(motors.names) > mechanism.d and has_limits:
        notes.append(
            "redundant motors: torques of minimum norm are clipped at the motors' limits, where a run shares what "
            "exceeds a limit among the other motors"
        )
    if len(motors.names) < mechanism.d:
        notes.append(
            f"{len(motors.names)} motors cannot produce every u of {mechanism.d} freedoms: the controllers return "
            "the status UNDRIVEN"
        )
    return notes


def make_prefix(stem: str) -> str:
    """Return an identifier of C in lower case."""
    prefix = re.sub(r"[^a-z0-9_]", "_", stem.lower())
    return f"m_{prefix}" if not prefix[0].isalpha() or prefix in RESERVED_PREFIXES else prefix


def _name(text: str, prefix: str) -> str:
    """Return a template's text with the mechanism's prefix in its names."""
    text = re.sub(r"\bmech(?=[_.)\s]|$)", prefix, text)
    return re.sub(r"\bMECH_", f"{prefix.upper()}_", text)


def _sizes(mechanism: Mechanism, functions: Mapping[str, Any]) -> dict[str, str]:
    sizes = {
        "NQ": mechanism.tree.nq,
        "N": mechanism.n,
        "D": mechanism.d,
        "Z": mechanism.n - mechanism.d,
        "ROWS": mechanism.closure.rows,
        "MOTORS": len(mechanism.motors.names),
        "POINTS": len(mechanism.points),
        "PARAMETERS": functions["numbers"].numel_in(0),
        "NUMBERS": functions["numbers"].numel_out(0),
    }
    return {name: str(size) for name, size in sizes.items()}


def _joint_places(mechanism: Mechanism) -> list[tuple[int, int]]:
    """Return the places in q' and in v' of all coordinates but those of free roots."""
    tree = mechanism.tree
    is_joint = [name not in tree.free_coordinates for name in tree.coordinates]
    return [(int(tree.q_index[k]), k) for k in range(tree.n) if is_joint[k]]


def _tables(mechanism: Mechanism) -> str:
    tree, partition, motors = mechanism.tree, mechanism.partition, mechanism.motors
    joints = _joint_places(mechanism)
    angles = [in_q for in_q, k in joints if not tree.in_metres[k]]
    q_places = [int(tree.q_index[k]) for k in partition.q]
    return "\n".join(
        [
            f"enum {{ JOINTS = {len(joints)}, ROOTS = {len(tree.free_roots)}, ANGLES = {len(angles)} }};",
            "/* Places in q_tree and in v_tree of joints and of free roots; places in q_tree of angles. */",
            table("int", "JOINT", joints, 2),
            table("int", "ROOT", [(int(a), int(b)) for a, b in tree.free_roots], 2),
            table("int", "ANGLE", angles),
            "/* Places of the coordinates of v_tree in q_tree; of q and z in v_tree; rows that are not redundant. */",
            table("int", "PLACE", tree.q_index.tolist()),
            table("int", "INDEPENDENT", partition.q.tolist()),
            table("int", "DEPENDENT", partition.z.tolist()),
            table("int", "KEPT", mechanism.independent_rows),
            "/* 1 rad, or the size of the mechanism in m; shaft rates by joint rates; limits of tau. */",
            table("double", "SCALE", tree.step_scale.tolist()),
            table("double", "TRANSMISSION", np.ravel(motors.transmission, order="F").tolist()),
            table("double", "LOWEST_TAU", motors.torque_limit[0].tolist()),
            table("double", "HIGHEST_TAU", motors.torque_limit[1].tolist()),
            "",
            f"const double mech_assembled[MECH_NQ] = {initializer(mechanism.q_tree)};",
            f"const int mech_q_places[MECH_D] = {initializer(q_places)};",
            f"const mech_parameters mech_default_parameters = {initializer(_parameter_values(mechanism))};",
        ]
    )


def _enumerators(mechanism: Mechanism, prefix: str) -> dict[str, list[str]]:
    """Return names of the places of coordinates, of independent coordinates and of motors, in the order of these."""
    groups = {"V": mechanism.coordinates, "Q": mechanism.independent, "TAU": mechanism.motors.names}
    return {
        group: [f"{prefix.upper()}_{group}_{name}" for name in identifiers(name.upper() for name in names)]
        for group, names in groups.items()
    }


def _places(enumerators: Mapping[str, list[str]]) -> dict[str, str]:
    v, q, tau = (", ".join(enumerators[group]) for group in ("V", "Q", "TAU"))
    return {"V_PLACES": v, "Q_PLACES": q, "TAU_PLACES": f"enum {{ {tau} }};\n" if tau else ""}


def _parameter_values(mechanism: Mechanism) -> list[float]:
    numbers = model_numbers(mechanism)
    return [float(x) for x in values(numbers, present(numbers))]


def _parameters(mechanism: Mechanism) -> dict[str, str]:
    """Return the fields of the struct of parameters, and a list of them."""
    which = present(model_numbers(mechanism))
    names = argument_names(mechanism, which)
    units = [f", {unit}".replace("²", "^2") if unit else "" for unit in argument_units(mechanism, which)]
    fields = identifiers(names)
    lines = [
        f"  double {field}; /* {comment(name)}{unit} */" for field, name, unit in zip(fields, names, units, strict=True)
    ]
    return {"FIELDS": "\n".join(lines), "OWN": ", ".join(f"parameters->{field}" for field in fields)}


def _describe_coordinates(mechanism: Mechanism, enumerators: Mapping[str, list[str]]) -> str:
    """Return the orders of coordinates, constraint rows and motors for the header, with their names in C."""
    tree, partition = mechanism.tree, mechanism.partition
    place = {int(k): f"q[{i}]" for i, k in enumerate(partition.q)}
    place |= {int(k): f"z[{i}]" for i, k in enumerate(partition.z)}
    lines = [
        "Coordinates: place in v_tree, its name in C, coordinate, unit, place in q_tree, independent (q) or not (z)"
    ]
    for k, (name, unit) in enumerate(zip(tree.coordinates, tree.units(), strict=True)):
        in_q = "free root" if name in tree.free_coordinates else f"q_tree[{tree.q_index[k]}]"
        lines.append(f"  {k}  {enumerators['V'][k]}  {comment(name)}  {unit}  {in_q}  {place[k]}")
    for in_q, in_v in tree.free_roots:
        lines.append(
            f"  Free root: v_tree[{in_v}] to [{in_v + 5}] are velocity and angular velocity in its own axes, "
            f"q_tree[{in_q}] to [{in_q + 6}] position (m) and quaternion x, y, z, w of length 1."
        )
    lines += ["", "Constraint rows: place in phi, row"]
    for k, row in enumerate(mechanism.closure.names):
        name = ".".join(row)
        lines.append(f"  {k}  {comment(name)}{', redundant' if name in mechanism.redundant else ''}")
    lines += ["", "Motors: place in tau, its name in C, motor; N m or N at the shaft"]
    lines += [f"  {k}  {enumerators['TAU'][k]}  {comment(name)}" for k, name in enumerate(mechanism.motors.names)]
    return "\n".join(f"   {line}".rstrip() for line in lines)


def _stack_bytes(mechanism: Mechanism, functions: Mapping[str, Any]) -> int:
    """Return an upper bound of the stack in bytes: the deepest chain of calls, with all variables in memory."""
    n, d, rows, motors = mechanism.n, mechanism.d, mechanism.closure.rows, len(mechanism.motors.names)
    z, nq = n - d, mechanism.tree.nq
    configuration = 3 * nq + rows * (n + 1) + z * z + z + n * d + 2

    def chain(*doubles: int) -> int:
        return sum(FRAME_BYTES + 8 * count for count in doubles)

    code = {name: count_operations(f) + 2 * (f.n_in() + f.n_out()) for name, f in functions.items()}
    reduced_force = (n + 3 * n + rows + n, max(code["bias"], 5 * n + rows + z + code["bilinear"]))
    forward = (n * n + d * d + 2 * n + 3 * d + d, *reduced_force)
    sigma = (2 * d + n + z, code["place"])
    tracking = (configuration + n * n + 3 * d, *reduced_force)
    chains = [
        chain(functions["numbers"].numel_in(0), code["numbers"]),
        chain(configuration + 6 * d, *forward),
        chain(configuration + 6 * d, *sigma),
        chain(*tracking),
        chain(configuration + d, 2 * d, *sigma),
        chain(configuration + d, motors * d + d * d + 2 * d),
        chain(n * n + 2 * d + n, *reduced_force),
        chain(n * n + 4 * n + 2 * rows + z + 1, max(code["acceleration"], code["bias"], code["inertia"])),
    ]
    return max(chains)
