"""Compiled terms as shared libraries: looked up in the user's cache, or compiled, checked and stored there.

A cached file is called KEY-COMPILER-CONTENT.so, three hashes: of everything that enters the code, of the compiler with
its flags, and of the file itself. A file whose content has another hash is compiled again instead of loaded. Two
processes may write the same file at the same time: the later one replaces the earlier one.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Mapping
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np
from msgspec import Struct

from ckc_pin.base.arrays import Array, BoolArray
from ckc_pin.base.atomic_files import open_atomic, temporary_folder
from ckc_pin.base.sources import Sources
from ckc_pin.codegen.arguments import present, values
from ckc_pin.codegen.compiler import Compiler, compile_c, find_compiler, hash_of
from ckc_pin.codegen.structure import structure_key
from ckc_pin.errors import InputError, MechanismError
from ckc_pin.kinematics.loading import build
from ckc_pin.mechanism.library import MECHANISM_FILE
from ckc_pin.mechanism.mechanism import Mechanism
from ckc_pin.mechanism.parameter_map import model_numbers

__all__ = [
    "Library",
    "cache_folder",
    "compile_terms",
    "explain_too_large",
    "find_compiled_terms",
    "is_private",
    "process_folder",
]

COMPILE_S_PER_CHARACTER = 4e-5  # s of the compiler per character of C source, measured in docs/theory/generated.md
# Limits of the size of a tree, so that the compiler takes at most two minutes. The second one limits the
# number of (coordinate, moved joint) pairs: a single branch reaches it with 40 joints.
MAX_COORDINATES, MAX_MOVED_JOINTS = 130, 820


class Library(Struct, frozen=True):
    """Compiled terms of one mechanism.

    Attributes
    ----------
    path : str
        The shared library.
    parameters : (k,) array
        The mechanism's numbers that its functions take as arguments.
    """

    path: str
    parameters: Array


def cache_folder() -> Path:
    """Return the folder of compiled terms in the user's cache."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if Path(base).is_absolute() else Path.home() / ".cache") / "ckc_pin" / "terms"


def explain_too_large(mechanism: Mechanism) -> str:
    """Return why a tree is too large for its terms to be compiled, or an empty text if it is not."""
    moved = int(mechanism.tree.support.sum())
    if mechanism.n <= MAX_COORDINATES and moved <= MAX_MOVED_JOINTS:
        return ""
    return (
        f"{mechanism.n} coordinates, which move {moved} joints, each its own and those behind it; "
        f"terms are compiled for trees of up to {MAX_COORDINATES} coordinates that move up to {MAX_MOVED_JOINTS}"
    )


def find_compiled_terms(
    mechanism: Mechanism,
    which: Mapping[str, BoolArray] | None = None,
    *,
    directional_derivatives: bool = False,
    of_members: bool = False,
) -> Library | None:
    """Return a mechanism's compiled terms if the cache has them and the file is intact; otherwise None.

    The arguments are those of `compile_terms`.
    """
    folder = cache_folder()
    if explain_too_large(mechanism) or not folder.is_dir():
        return None
    return _look_up(_Subject.of(mechanism, which, directional_derivatives, of_members), folder)


def compile_terms(
    mechanism: Mechanism,
    which: Mapping[str, BoolArray] | None = None,
    on_written: Callable[[float], None] | None = None,
    *,
    directional_derivatives: bool = False,
    of_members: bool = False,
    limited: bool = True,
) -> Library:
    """Return a mechanism's compiled terms: from the cache, compiled earlier in this process, or compiled now.

    Parameters
    ----------
    mechanism : Mechanism
    which : mapping, optional
        Numbers that are arguments (`arguments.present`), if these are more than the numbers that are not zero: a
        parameter may vary from zero.
    on_written : callable, optional
        Called once before the compiler starts, with the seconds that it may take.
    directional_derivatives : bool
        Whether to add directional derivatives of the acceleration, which takes longer to compile.
    of_members : bool
        Whether to add functions of several members of an ensemble at a time, which takes longer too.
    limited : bool
        Whether to refuse a tree that is too large. The compiler's only other limit is its timeout.

    Raises
    ------
    InputError
        The tree is too large, CasADi or a C compiler is missing or fails, no folder can be written to, or the compiled
        terms differ from Pinocchio's.
    """
    if limited and (reason := explain_too_large(mechanism)):
        raise InputError(f"{mechanism.name}: {reason}")
    subject = _Subject.of(mechanism, which, directional_derivatives, of_members)
    is_used = process_folder.cache_info().currsize > 0  # by terms that the cache could not take
    for folder in (cache_folder(), *([process_folder()] if is_used else [])):
        if (library := _look_up(subject, folder)) is not None:
            return library
    compiler = find_compiler(subject.directional_derivatives)
    if compiler is None:
        raise InputError("compiled terms need a C compiler: `cc` was not found on PATH")
    return _make(_with_numbers_of_files(mechanism, subject), subject, compiler, on_written)


class _Subject(Struct, frozen=True):
    """A mechanism's key in the cache, and the arguments of its code."""

    key: str
    parameters: Array
    which: Mapping[str, BoolArray]
    directional_derivatives: bool
    of_members: bool

    @classmethod
    def of(
        cls,
        mechanism: Mechanism,
        which: Mapping[str, BoolArray] | None,
        directional_derivatives: bool,
        of_members: bool,
    ) -> _Subject:
        mechanism_numbers = model_numbers(mechanism)
        which = which or present(mechanism_numbers)
        key = _key(mechanism, which, directional_derivatives, of_members)
        return cls(key, values(mechanism_numbers, which), which, directional_derivatives, of_members)


def _with_numbers_of_files(mechanism: Mechanism, subject: _Subject) -> Mechanism:
    """Return the mechanism with the numbers of its files, if it has the same library; otherwise the mechanism itself.

    The order of elimination then does not depend on which masses the library was first asked for with.
    """
    sources = mechanism.sources
    if MECHANISM_FILE not in sources.texts:
        return mechanism
    try:
        unchanged = build(sources.texts[MECHANISM_FILE], Sources(sources.name, sources.folder, sources.texts))
    except (InputError, MechanismError):  # the files' numbers may not assemble
        return mechanism
    is_covered = all(
        np.all(subject.which[name] | ~there) for name, there in present(model_numbers(unchanged)).items()
    )  # a number that an override sets to zero is no argument
    added = subject.directional_derivatives, subject.of_members
    same = is_covered and _key(unchanged, subject.which, *added) == subject.key
    return unchanged if same else mechanism


def _key(mechanism: Mechanism, which: Mapping[str, BoolArray], directional_derivatives: bool, of_members: bool) -> str:
    kind = directional_derivatives, of_members, platform.machine()
    return hash_of((structure_key(mechanism, which), *kind))[:32]


def _look_up(subject: _Subject, folder: Path) -> Library | None:
    """Return the cached file of a key and of the present compiler, or of any compiler if there is none."""
    try:
        if not _is_usable(folder):
            return None
        compiler = find_compiler(subject.directional_derivatives)
        asked = str(folder), subject.key, None if compiler is None else compiler.key
        path, state = _intact.get(asked, ("", None))
        if state is None or _state_of(path) != state:
            intact = _find_intact(*asked)
            if intact is None:
                return None
            path, _ = _intact[asked] = intact
        return Library(path, subject.parameters)
    except OSError:
        return None


FileState = tuple[int, int, int]  # inode, bytes, time of the last change: another one if the file was replaced
# Libraries that this process has found, with the state in which their content was intact: by folder, key of the
# mechanism and key of the compiler (None: there is no compiler). Listing a folder of many files takes longer than the
# rest of a look-up.
_intact: dict[tuple[str, str, str | None], tuple[str, FileState]] = {}


def _state_of(path: str) -> FileState | None:
    try:
        stat = os.stat(path)
    except FileNotFoundError:
        return None
    return stat.st_ino, stat.st_size, stat.st_mtime_ns


def _find_intact(folder: str, key: str, compiler_key: str | None) -> tuple[str, FileState] | None:
    """Return a library whose content has the hash in its name, and the file's state."""
    for name in sorted(os.listdir(folder)):
        if not (name.startswith(f"{key}-") and name.endswith(".so")):
            continue
        _, compiler, content = name.removesuffix(".so").rsplit("-", 2)
        path = os.path.join(folder, name)
        is_of_compiler = compiler_key is None or compiler == compiler_key
        state = _state_of(path)  # before the content is read
        if state and is_of_compiler and content == sha256(Path(path).read_bytes()).hexdigest()[:32]:
            return path, state
    return None


def is_private(folder: Path) -> bool:
    """Return whether only this user can write to a folder."""
    stat = folder.stat()
    return stat.st_uid == os.getuid() and not stat.st_mode & 0o022


def _is_usable(folder: Path) -> bool:
    """Return whether only this user can write to a folder, and libraries can be loaded from it."""
    return is_private(folder) and _allows_execution(folder)


def _allows_execution(folder: Path) -> bool:
    """Return whether the folder's file system is mounted without `noexec`."""
    return not os.statvfs(folder).f_flag & getattr(os, "ST_NOEXEC", 0)  # Linux only


def _make(
    mechanism: Mechanism, subject: _Subject, compiler: Compiler, on_written: Callable[[float], None] | None
) -> Library:
    """Write, compile, check and store a mechanism's terms."""
    import tempfile

    from ckc_pin.codegen.comparison import require_equal_terms
    from ckc_pin.codegen.term_functions import TermFunctions

    folders = (Path(tempfile.gettempdir()), cache_folder())
    place = next((folder for folder in folders if folder.is_dir() and _allows_execution(folder)), None)
    if place is None:
        raise InputError(f"compiled terms cannot be loaded: neither {folders[0]} nor {folders[1]} allows programs")
    with temporary_folder(place) as folder:
        source, library = folder / "terms.c", folder / "terms.so"
        text = TermFunctions.of(
            mechanism,
            subject.which,
            directional_derivatives=subject.directional_derivatives,
            of_members=subject.of_members,
        ).c_source()
        if on_written is not None:
            on_written(len(text) * COMPILE_S_PER_CHARACTER)
        try:
            source.write_text(text, encoding="ascii")
            compile_c(compiler, source, library, mechanism.name)
        except OSError as error:
            raise InputError(f"{mechanism.name}: its terms cannot be compiled: {error.strerror}") from error
        require_equal_terms(mechanism, Library(str(library), values(model_numbers(mechanism), subject.which)))
        content = library.read_bytes()
        name = f"{subject.key}-{compiler.key}-{sha256(content).hexdigest()[:32]}.so"
        return Library(str(_store(name, content)), subject.parameters)


def _store(name: str, content: bytes) -> Path:
    """Write a library to the cache, or if that is impossible to a folder that is removed when the process ends."""
    try:
        folder = cache_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if _is_usable(folder):
            return _write_file(folder / name, content)
    except (OSError, InputError):
        pass
    return _write_file(process_folder() / name, content)


def _write_file(path: Path, content: bytes) -> Path:
    with open_atomic(path) as file:
        file.write(content)
    return path


@cache
def process_folder() -> Path:
    """Return a temporary folder for files that cannot be stored in the user's cache; it is removed at exit."""
    import atexit
    import shutil
    import tempfile

    folder = tempfile.mkdtemp(prefix="ckc_pin-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
