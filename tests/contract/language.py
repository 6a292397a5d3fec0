"""The project's words: names and phrases to avoid, what to write instead, and where they still stand.

`NAMES` and `PHRASES` list only names and phrases that have no other use, so that a hit is never good English in
another sense. Rooms that are not yet clean are listed in `language_bounds.toml` with their present counts. The counts
may only fall: `python -m tests.contract.language` writes them anew after a room was cleaned or moved, and refuses to
raise their total. `python -m tests.contract.language ROOM` prints the hits in a room, `ROOM` being a key of that file.
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from bisect import bisect
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

__all__ = [
    "BOUNDS", "NAMES", "PHRASES", "Hit", "Module", "bounds", "check_name", "check_prose", "count", "hits", "main",
    "read_module", "rooms",
]  # fmt: skip

ROOT = Path(__file__).resolve().parents[2]
BOUNDS = Path(__file__).with_name("language_bounds.toml")
THIS = {"tests/contract/language.py", "tests/contract/test_names.py"}  # they quote what they forbid

# --- the vocabulary --------------------------------------------------------------------------------

QUANTITY = "the quantity that it is: solution, step, config, tolerance, members"
LIMIT = "what it limits, with its unit: MAX_NEWTON_STEP_RAD, RANK_TOLERANCE"
VERB = "verb and object: project_onto_manifold, find_event, is_reachable"
DERIVATIVE = "parameter derivative, sensitivity"

# whole identifiers, without underscores and digits at either end; lower case
NAMES = {
    **dict.fromkeys(("found", "made", "given", "known", "own", "own_one", "wanted", "every"), QUANTITY),
    **dict.fromkeys(("changes", "changing"), "overrides, parameters"),
    **dict.fromkeys(("vary", "varied", "varying"), "rebuild with parameters, parameter derivative"),
    **dict.fromkeys(("holds", "holding"), "joint mode: sticking, sliding, at stop, free"),
    **dict.fromkeys(("least", "most"), "min_..., max_..., smallest_..., minimum_norm_..."),
    **dict.fromkeys(("near", "slack"), "tolerance, threshold, is_near"),
    **dict.fromkeys(("look", "keep", "within", "tidy", "settle", "shows", "beside", "whole"), VERB),
    "left": "remaining_time, remaining (or left and right, of two sides)",
    "met": "occurrences of an event, triggered",
    "ahead": "remaining interval",
    "apart": "non-differentiable, separate",
    "alike": "identical",
    "plain": "to_dict, to_json, serialize",
}
ONLY_FUNCTIONS = {
    "look", "keep", "within", "tidy", "settle", "shows", "beside", "whole", "plain", "alike", "apart",
    "back", "made", "shown", "along", "written",
}  # fmt: skip
NAMES |= dict.fromkeys(ONLY_FUNCTIONS - NAMES.keys(), VERB)
CPP_ALSO = {"back", "made", "shown", "along"}  # std::vector::back, and variables that C++'s tokens do not tell apart

# words of an identifier: `joint_card` and `JointCard` have "card"
WORDS = {
    **dict.fromkeys(("card", "cards"), "summary"),
    **dict.fromkeys(("sway", "sways"), "mode animation"),
    **dict.fromkeys(("stranger", "strangers"), "untrusted input, user's files"),
    **dict.fromkeys(("manner", "manners", "door", "doors"), "validation of arguments"),
    **dict.fromkeys(("effect", "effects", "variation", "variations"), DERIVATIVE),
    **dict.fromkeys(("finding", "findings"), "warning, note"),
}
PATTERNS = {
    r"^(test_)?what_": QUANTITY,
    r"joint_?changes?$|^JointChanges?": "joint mode, mode transition",
    r"^(with_?)?written_|^Written|^With_?Written": "compiled terms, compiled library",
    r"_plain$|_card$": "to_dict, summary",
    r"Within_?Limits|within_limits": "limited closed loop",
}

OF_PINOCCHIO = {"nonLinearEffects", "computeJointJacobiansTimeVariation"}

# constants of a module, which have none of the words "least" and "most" either
CONSTANTS = {
    "FLAT", "OFF", "SAME", "SHORT", "CLOSE", "NEAR", "NEARLY", "EVERY", "ALIKE", "FAR", "SURE", "POOR", "APART",
    "BESIDE", "LOOSE", "SLACK", "LONG", "FEW", "MANY", "GOOD", "SMALL",
}  # fmt: skip

# phrases of docs, docstrings, comments and messages: regular expressions of whole words
PHRASES = {
    r"written out": "compiled",
    r"generated (terms|library|code)": "compiled terms, compiled library",
    r"who (steps|calls|asks|slides|sticks|touches)": "the caller; the joints that ...",
    r"strangers?('s)?": "untrusted input, user-supplied",
    r"(is|are|was|were) not known": "unknown, unsupported, not computed",
    r"no time of its own": "not differentiable here",
    r"which is why": "two sentences",
    r"what (acts|drives|loops carry|holds a)": "actuator, motor torque, generalized force, constraint forces",
    r"what there is to see": "summary",
    r"what is (left|due|held|kept|missed)": "remainder, residual, remaining interval, stored outputs",
    r"what of (a|the|it)": "the noun: the parts of a scene that ...",
    r"whose terms|the numbers in use": "compiled or Pinocchio terms, parameter values",
    r"changed mechanism": "rebuilt mechanism",
    r"may not be meant": "may be unintended",
    r"(on|off|onto|to) the closure": "on (off, onto) the constraint manifold",
    r"made again|makes? (it|them|the step|a step) again": "rejected and repeated",
    r"passed over": "triggered, skipped, ignored",
    r"sway(s|ed|ing)?": "mode animation, oscillate in a mode",
    r"how (?:[\w'’/-]+ ){1,5}changes?": "sensitivity, parameter derivative, derivative of",
    r"findings|a finding": "warnings",
    r"(its|their) doors?|manners?": "validation of arguments",
    r"least (singular|norm|eigenvalue|tau)|of least(?! squares)": "smallest, minimum-norm",
    r"slack": "tolerance",
    r"tak(e|es|en|ing) apart": "factorized, decomposed",
    r"anew": "again, restart",
    r"(is|are) (not |never )?looked for": "monitored, searched",
    r"turn(s|ed|ing)? round": "reverses",
    r"branches (that are )?alike|alike branches": "identical branches",
    r"(go|goes|gone|going) on with": "resume, continue",
    r"trail": "initial guess, warm start",
    r"cards?": "summary",
    r"tid(y|ies|ied)": "synchronize, recover",
    r"refused steps?|steps? (that )?(is|are|was) refused|refus(es|e|ing) (the|a) step": "rejected step",
    r"joint changes?": "joint mode, mode transition",
    r"joints' changes": "mode transitions",
}  # fmt: skip
_ANY_PHRASE = re.compile("|".join(PHRASES), re.IGNORECASE)
_MARK = re.compile(r"^\s*(//+|#+|\*)?\s*")
_PHRASE = {re.compile(rf"(?<![\w-])(?:{phrase})(?![\w-])", re.IGNORECASE): say for phrase, say in PHRASES.items()}


@dataclass(frozen=True)
class Hit:
    """A name or phrase to avoid, where it stands, and what to write instead."""

    file: str
    line: int
    text: str
    say: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.text}: write {self.say}"


# --- what is wrong with a name or a text -----------------------------------------------------------


def _words(name: str) -> list[str]:
    """Words of ``_JointCard_of``: joint, card, of."""
    return [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]


@cache
def check_name(name: str, function: bool = False, constant: bool = False, cpp: bool = False) -> str | None:
    """Return what to write instead of an identifier, None where it is good.

    `function`: it names a function or class. `constant`: it names a constant of a module (of C++: constexpr).
    `cpp`: a token of C++, of which functions cannot be told from variables.
    """
    if name in OF_PINOCCHIO:
        return None
    bare = name.strip("_").rstrip("0123456789_")
    words = _words(bare)
    if constant and (bare.upper() in CONSTANTS or ({"least", "most"} & set(words) and "squares" not in words)):
        return LIMIT
    lower = bare.lower()
    if lower in NAMES and (function or lower not in ONLY_FUNCTIONS or (cpp and lower not in CPP_ALSO)):
        return NAMES[lower]
    return next(
        (say for pattern, say in PATTERNS.items() if re.search(pattern, bare)),
        next((WORDS[word] for word in words if word in WORDS), None),
    )


def check_prose(text: str) -> list[tuple[int, str, str]]:
    """Return phrases to avoid in a text: (line from 0, phrase, what to write instead)."""
    lines = [_MARK.sub("", line).rstrip() for line in text.split("\n")]
    flat = " ".join(lines)
    if not _ANY_PHRASE.search(flat):
        return []
    starts, at = [], 0
    for line in lines:
        starts.append(at)
        at += len(line) + 1
    return [
        (sum(start <= match.start() for start in starts) - 1, match[0], say)
        for phrase, say in _PHRASE.items()
        for match in phrase.finditer(flat)
    ]


# --- Python ----------------------------------------------------------------------------------------


_STRING_OR_COMMENT = re.compile(
    r"'''(?:\\.|.)*?'''|\"\"\"(?:\\.|.)*?\"\"\"|'(?:\\.|[^'\\\n])*'|\"(?:\\.|[^\"\\\n])*\"|#[^\n]*", re.DOTALL
)


def _comments(text: str) -> Iterator[tuple[int, str]]:
    """Comments of a module, with their lines."""
    ends = [match.start() for match in re.finditer("\n", text)]
    for match in _STRING_OR_COMMENT.finditer(text):
        if match[0].startswith("#"):
            yield bisect(ends, match.start()) + 1, match[0]


def _bindings(tree: ast.Module, nodes: list[ast.AST]) -> Iterator[tuple[int, str, bool, bool]]:
    """Names that a module binds: (line, name, is a function or class, is a constant of the module)."""
    top = {id(node) for statement in tree.body if isinstance(statement, ast.Assign | ast.AnnAssign)
           for node in ast.walk(statement)}  # fmt: skip
    for node in nodes:
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, name, True, False
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield node.lineno, name, False, name.isupper() and id(node) in top
            case ast.arg(arg=name):
                yield node.lineno, name, False, False


def _python_prose(text: str, nodes: list[ast.AST]) -> Iterator[tuple[int, str]]:
    """Comments and strings of a module, with their first lines; comments on consecutive lines are one."""
    inside_f = set()
    for node in nodes:
        if isinstance(node, ast.JoinedStr):
            inside_f |= {id(value) for value in node.values}
            yield node.lineno, "".join(str(v.value) if isinstance(v, ast.Constant) else "{}" for v in node.values)
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inside_f:
            yield node.lineno, node.value
    block, start, last = [], 0, -1
    for line, comment in _comments(text):
        if line != last + 1:
            yield start, "\n".join(block)
            block, start = [], line
        block.append(comment)
        last = line
    yield start, "\n".join(block)


def _identifiers(nodes: list[ast.AST]) -> Iterator[tuple[int, str]]:
    """Every identifier that a module makes or uses, with its line."""
    for node in nodes:
        fields = vars(node)
        for field in ("id", "attr", "arg", "name", "asname"):
            if isinstance(fields.get(field), str):
                yield fields.get("lineno", 0), fields[field]


@dataclass(frozen=True)
class Module:
    """What the tests need of a module, so that it is parsed once.

    `classes` are the public ones at its top, `identifiers` have their lines, and `hits` their kinds.
    """

    classes: tuple[str, ...]
    identifiers: frozenset[tuple[int, str]]
    hits: tuple[tuple[str, Hit], ...]


@cache
def read_module(file: str) -> Module:
    """Read a Python file, given as a path from the project's top."""
    text = (ROOT / file).read_text(encoding="utf-8")
    tree = ast.parse(text)
    nodes = list(ast.walk(tree))
    classes = tuple(x.name for x in tree.body if isinstance(x, ast.ClassDef) and not x.name.startswith("_"))
    return Module(classes, frozenset(_identifiers(nodes)), tuple(_python_hits(file, text, tree, nodes)))


def _python(file: str) -> Iterator[tuple[str, Hit]]:
    yield from read_module(file).hits


def _python_hits(file: str, text: str, tree: ast.Module, nodes: list[ast.AST]) -> Iterator[tuple[str, Hit]]:
    names = list(_bindings(tree, nodes))
    sides = any(name.strip("_").startswith("right") for _, name, _, _ in names)
    for line, name, function, constant in names:
        say = check_name(name, function, constant)
        if say and not (sides and name.strip("_").startswith("left")):
            yield "names", Hit(file, line, name, say)
    for start, prose in _python_prose(text, nodes):
        for line, phrase, say in check_prose(prose):
            yield "phrases", Hit(file, start + line, phrase, say)


# --- C++ and Markdown ------------------------------------------------------------------------------

_CPP = re.compile(r'//[^\n]*|/\*.*?\*/|"(?:\\.|[^"\\\n])*"|[A-Za-z_]\w*', re.DOTALL)


def _cpp(file: str) -> Iterator[tuple[str, Hit]]:
    text = (ROOT / file).read_text(encoding="utf-8")
    constants = set(re.findall(r"\bconstexpr\s+[\w:<>]+\s+(\w+)\s*=", text))
    tokens = [(match.start(), match[0]) for match in _CPP.finditer(text)]
    sides = any(token.strip("_") == "right" for _, token in tokens)
    prose: list[tuple[int, str]] = []
    ends = [match.start() for match in re.finditer("\n", text)]
    for at, token in tokens:
        line = bisect(ends, at) + 1
        if token.startswith("//") and prose and prose[-1][1].startswith("//"):
            first, before = prose[-1]
            if first + before.count("\n") + 1 == line:
                prose[-1] = (first, f"{before}\n{token}")
                continue
        if token.startswith(("//", "/*", '"')):
            prose.append((line, token))
            continue
        say = check_name(token, constant=token in constants, cpp=True)
        if say and not (sides and token.strip("_") == "left"):
            yield "names", Hit(file, line, token, say)
    for start, words in prose:
        for line, phrase, say in check_prose(words):
            yield "phrases", Hit(file, start + line, phrase, say)


def _markdown(file: str) -> Iterator[tuple[str, Hit]]:
    for line, phrase, say in check_prose((ROOT / file).read_text(encoding="utf-8")):
        yield "phrases", Hit(file, line + 1, phrase, say)


# --- rooms -----------------------------------------------------------------------------------------

READERS = {".py": _python, ".cpp": _cpp, ".hpp": _cpp, ".md": _markdown, ".j2": _markdown}
TOPS = ("ckc_pin", "docs", "examples", "scripts", "tests")


def _room(file: str) -> str:
    """Room of a file: ``ckc_pin/control``, ``ckc_pin/native/src``, ``docs/guide``; files at the top are in ``.``."""
    folders = file.split("/")[:-1]
    return "/".join(folders[: 3 if file.startswith("ckc_pin/native/src/") else 2]) or "."


@cache
def rooms() -> dict[str, list[str]]:
    """Files of each room, without those of the vocabulary itself."""
    paths = [path for top in TOPS for path in (ROOT / top).rglob("*")] + list(ROOT.glob("*.md"))
    files = {path.relative_to(ROOT).as_posix() for path in paths if path.suffix in READERS} - set(THIS)
    by_room: dict[str, list[str]] = {}
    for file in sorted(files):
        by_room.setdefault(_room(file), []).append(file)
    return by_room


@cache
def hits() -> dict[str, dict[str, list[Hit]]]:
    """Names and phrases to avoid, by room and by what they are ("names", "phrases")."""
    return {room: _hits_of(files) for room, files in rooms().items()}


def _hits_of(files: list[str]) -> dict[str, list[Hit]]:
    kinds: dict[str, list[Hit]] = {"names": [], "phrases": []}
    for file in files:
        for kind, hit in READERS[Path(file).suffix](file):
            kinds[kind].append(hit)
    return kinds


def count() -> dict[str, dict[str, int]]:
    """Return how many hits each room has."""
    return {room: {kind: len(some) for kind, some in kinds.items()} for room, kinds in hits().items()}


def bounds() -> dict[str, dict[str, int]]:
    """Return the most hits that a room may have, of rooms that are not yet clean."""
    return tomllib.loads(BOUNDS.read_text(encoding="utf-8")) if BOUNDS.exists() else {}


def main() -> int:
    """Write the bounds of all rooms, lower than before; or print the hits of the rooms that are named."""
    if sys.argv[1:]:
        for room in sys.argv[1:]:
            print(*(hit for some in hits()[room].values() for hit in some), sep="\n")
        return 0
    counts = {room: kinds for room, kinds in count().items() if any(kinds.values())}
    old, new = (sum(sum(kinds.values()) for kinds in table.values()) for table in (bounds(), counts))
    if BOUNDS.exists() and new > old:
        print(f"{new} names and phrases to avoid, {old} before: the bounds may only fall", file=sys.stderr)
        return 1
    rows = [
        f'"{room}" = {{ names = {kinds["names"]}, phrases = {kinds["phrases"]} }}' for room, kinds in counts.items()
    ]
    head = (
        "# Rooms that are not yet clean, with how many names and phrases to avoid they have: tests/contract/language.py"
    )
    BOUNDS.write_text("\n".join([head, *rows, ""]), encoding="utf-8")
    print(f"{BOUNDS.relative_to(ROOT)}: {new} in {len(rows)} rooms ({old} before)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
