"""Written-out terms as shared libraries: found in the user's cache, or compiled, checked and put there.

A file of the cache is called KEY-COMPILER-CONTENT.so: the hash of all that enters the code, of the compiler and its
flags, and of the file itself. One whose content is another is not loaded but made again. Two processes that make the
same file at once both succeed, the second one's replaces the first one's.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path

import msgspec
import numpy as np

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.base.atomic_files import open_atomic, temporary_folder
from ckc_pin.base.sources import Sources
from ckc_pin.codegen.arguments import numbers, present, values
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.kinematics.loading import build
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.rows import RelativeLog

__all__ = ["Library", "cache_folder", "compiled", "find", "too_large"]

FLAGS = ("-O2", "-std=c99", "-fPIC", "-shared", "-w")
# Products and sums are fused where the acceleration's changes are found too, so that the processor's cache of
# instructions holds both. A plain run's last digits stay those of processors that cannot fuse.
EXACT, FUSED = "-ffp-contract=off", "-ffp-contract=fast"
PATIENCE = 600.0  # s, for the compiler
PER_LETTER = 4e-5  # s of the compiler for a letter of the text, as docs/theory/generated.md has them
# Of a tree that is written out, with two minutes of the compiler at the most: its coordinates, and the joints that each
# of them moves, all added up, as many as 40 in one branch do.
MOST_COORDINATES, MOST_MOVED = 130, 820


@dataclass(frozen=True)
class Library:
    """Terms of one mechanism, compiled.

    Attributes
    ----------
    path : str
        The shared library.
    parameters : (k,) array
        The mechanism's numbers, which its code takes as arguments.
    """

    path: str
    parameters: Array


def cache_folder() -> Path:
    """Return where compiled terms are kept: the user's cache, whose folder nobody else writes to."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if Path(base).is_absolute() else Path.home() / ".cache") / "ckc_pin" / "terms"


def too_large(mechanism: Mechanism) -> str:
    """Say why a tree is too large for its terms to be written out; an empty text where it is not."""
    moved = int(mechanism.tree.support.sum())
    if mechanism.n <= MOST_COORDINATES and moved <= MOST_MOVED:
        return ""
    return (
        f"{mechanism.name}: {mechanism.n} coordinates, which move {moved} joints, each its own and those behind it; "
        f"terms are written out for trees of up to {MOST_COORDINATES} coordinates that move up to {MOST_MOVED}"
    )


def find(
    mechanism: Mechanism, which: Mapping[str, BoolArray] | None = None, *, changes: bool = False
) -> Library | None:
    """Return the mechanism's terms if they were compiled before; None if not, or if the file has changed since.

    `which` and `changes` as of `compiled`.
    """
    folder = cache_folder()
    if too_large(mechanism) or not folder.is_dir():
        return None
    return _look(_Subject.of(mechanism, which, changes), folder)


def compiled(
    mechanism: Mechanism,
    which: Mapping[str, BoolArray] | None = None,
    on_written: Callable[[float], None] | None = None,
    *,
    changes: bool = False,
    limited: bool = True,
) -> Library:
    """Return the mechanism's terms, from the cache or compiled now.

    Parameters
    ----------
    mechanism : Mechanism
    which : mapping, optional
        Which numbers are arguments (`arguments.present`), where that is more than those that are not zero: what is
        varied from zero.
    on_written : callable, optional
        Called once before the compiler, with the seconds that it may take.
    changes : bool
        With how the acceleration changes along any direction (`code.functions`), a longer text.
    limited : bool
        Whether a tree that is `too_large` is refused; the compiler has no other limit than its patience.

    Raises
    ------
    InputError
        A tree that is too large, no CasADi, no C compiler or one that fails, no place to write, or code whose
        results are not those of Pinocchio.
    """
    if limited and (reason := too_large(mechanism)):
        raise InputError(reason)
    subject = _Subject.of(mechanism, which, changes)
    found = _look(subject, cache_folder())
    if found is not None:
        return found
    compiler = _compiler(subject.changes)
    if compiler is None:
        raise InputError("no C compiler: terms are written out as C, which needs `cc` on PATH")
    return _make(_with_numbers_of_files(mechanism, subject), subject, compiler, on_written)


@dataclass(frozen=True)
class _Subject:
    """What a mechanism's library is found by, and what its code takes."""

    key: str
    parameters: Array
    which: Mapping[str, BoolArray]
    changes: bool

    @classmethod
    def of(cls, mechanism: Mechanism, which: Mapping[str, BoolArray] | None, changes: bool) -> _Subject:
        given = numbers(mechanism)
        which = which or present(given)
        return cls(_key(mechanism, which, changes), values(given, which), which, changes)


def _with_numbers_of_files(mechanism: Mechanism, subject: _Subject) -> Mechanism:
    """Return the mechanism with the numbers of its files, if it has the same library; otherwise the mechanism itself.

    The order of elimination then does not depend on which masses the library was first asked for with.
    """
    sources = mechanism.sources
    if MECHANISM_FILE not in sources.texts:
        return mechanism
    try:
        unchanged = build(sources.texts[MECHANISM_FILE], Sources(sources.name, sources.folder, sources.texts))
    except (InputError, MechanismError):  # numbers with which it cannot be assembled
        return mechanism
    return unchanged if _key(unchanged, subject.which, subject.changes) == subject.key else mechanism


@dataclass(frozen=True)
class _Compiler:
    path: str
    flags: tuple[str, ...]
    key: str


def _compiler(fuses: bool) -> _Compiler | None:
    import shutil

    path = shutil.which("cc")
    if path is None:
        return None
    flags = (*FLAGS, FUSED if fuses else EXACT, *_machine_flags(fuses))
    real = Path(path).resolve()
    stat = real.stat()
    return _Compiler(path, flags, _hash((str(real), stat.st_size, stat.st_mtime_ns, flags))[:16])


@cache
def _machine_flags(fuses: bool) -> tuple[str, ...]:
    """Wider registers and, where it may fuse, fused operations, if the machine has them."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return ()
    try:
        there = set(Path("/proc/cpuinfo").read_text(encoding="ascii").split())
    except OSError:
        return ()
    return tuple(f"-m{x}" for x in ("avx2", "fma") if x in there and (fuses or x != "fma"))


def _hash(what: object) -> str:
    return sha256(msgspec.json.encode(what, order="deterministic")).hexdigest()


def _key(mechanism: Mechanism, which: Mapping[str, BoolArray], changes: bool) -> str:
    """The hash of all that enters the code: our own text, the tree, the table of rows, and which numbers are zero."""
    tree, closure = mechanism.tree, mechanism.closure
    model = tree.model
    joints = [
        (
            parent,
            joint.idx_q,
            joint.idx_v,
            placement.rotation.tolist(),
            None if joint.nq == 7 else (tree.axis(k)[0].tolist(), bool(tree.axis(k)[1])),
        )
        for k, (parent, joint, placement) in enumerate(
            zip(model.parents, model.joints, model.jointPlacements, strict=True)
        )
        if k > 0
    ]
    groups = [
        (
            type(group).__name__,
            {name: np.asarray(x).tolist() for name, x in vars(group).items() if _is_constant(group, name)},
        )
        for group in closure.groups
    ]
    anchors = closure.anchors
    table = (anchors.point_joint.tolist(), anchors.direction_joint.tolist(), anchors.direction_local.tolist())
    there = {name: x.tolist() for name, x in which.items()}
    springs = mechanism.springs.anchors.point_joint.tolist()
    kind = (mechanism.redundant, changes, platform.machine())
    return _hash((_own_text(), joints, groups, table, there, springs, *kind))[:32]


def _is_constant(group: object, name: str) -> bool:
    return isinstance(group, RelativeLog) or name in ("out", "pair", "direction", "a", "b")


@cache
def _own_text() -> str:
    folder = Path(__file__).parent
    return _hash([path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.py"))])


def _look(subject: _Subject, folder: Path) -> Library | None:
    """A file of that key, of the compiler that there is or, where there is none, of any."""
    try:
        there = sorted(folder.glob(f"{subject.key}-*-*.so"))
        if not there or not _is_usable(folder):
            return None
        compiler = _compiler(subject.changes)
        for path in there:
            _, of_compiler, content = path.stem.rsplit("-", 2)
            fits = compiler is None or of_compiler == compiler.key
            if fits and content == sha256(path.read_bytes()).hexdigest()[:32]:
                return Library(str(path), subject.parameters)
    except OSError:
        return None
    return None


def _is_usable(folder: Path) -> bool:
    """Whether nobody else writes there, and programs are loaded from there."""
    stat = folder.stat()
    return stat.st_uid == os.getuid() and not stat.st_mode & 0o022 and _executes(folder)


def _executes(folder: Path) -> bool:
    """Whether the file system lets programs be loaded from there."""
    return not os.statvfs(folder).f_flag & getattr(os, "ST_NOEXEC", 0)  # a flag of Linux's


def _make(
    mechanism: Mechanism, subject: _Subject, compiler: _Compiler, on_written: Callable[[float], None] | None
) -> Library:
    import tempfile

    from ckc_pin.codegen.comparison import require_equal

    places = (Path(tempfile.gettempdir()), cache_folder())
    place = next((folder for folder in places if folder.is_dir() and _executes(folder)), None)
    if place is None:
        raise InputError(f"compiled terms cannot be loaded: neither {places[0]} nor {places[1]} allows programs")
    with temporary_folder(place) as folder:
        library = folder / "terms.so"
        _compile(mechanism, subject, compiler, folder / "terms.c", library, on_written)
        require_equal(mechanism, Library(str(library), values(numbers(mechanism), subject.which)))
        content = library.read_bytes()
        name = f"{subject.key}-{compiler.key}-{sha256(content).hexdigest()[:32]}.so"
        return Library(str(_put(name, content)), subject.parameters)


def _compile(
    mechanism: Mechanism,
    subject: _Subject,
    compiler: _Compiler,
    text: Path,
    library: Path,
    on_written: Callable[[float], None] | None,
) -> None:
    from ckc_pin.codegen.program import run_program

    try:
        from ckc_pin.codegen.code import Code

        written = Code.of(mechanism, subject.which, changes=subject.changes).text()
    except ModuleNotFoundError as error:
        says = "terms are written out by CasADi, which is not installed: pip install ckc_pin[symbolic]"
        raise InputError(says) from error
    if on_written is not None:
        on_written(len(written) * PER_LETTER)
    try:
        text.write_text(written, encoding="ascii")
        command = [compiler.path, *compiler.flags, "-o", str(library), str(text), "-lm"]
        done = run_program(command, PATIENCE, temporary=text.parent)
    except TimeoutError:
        raise InputError(f"{mechanism.name}: the C compiler took more than {PATIENCE:g} s for its terms") from None
    except OSError as error:
        raise InputError(f"{mechanism.name}: its terms cannot be compiled: {error.strerror}") from error
    if done.returncode != 0 or not library.exists():
        says = next((line for line in done.stderr.splitlines() if line.strip()), f"exit code {done.returncode}")
        raise InputError(f"{mechanism.name}: the C compiler fails: {says:.200}")


def _put(name: str, content: bytes) -> Path:
    """Write a library to the cache, or where that cannot be to a folder that goes with the process."""
    try:
        folder = cache_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if _is_usable(folder):
            return _written(folder / name, content)
    except (OSError, InputError):
        pass
    return _written(_own_folder() / name, content)


def _written(path: Path, content: bytes) -> Path:
    with open_atomic(path) as file:
        file.write(content)
    return path


@cache
def _own_folder() -> Path:
    import atexit
    import shutil
    import tempfile

    folder = tempfile.mkdtemp(prefix="ckc_pin-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
