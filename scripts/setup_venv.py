"""Make .venv: exact versions, checked hashes, the project editable. Standard library only.

    setup_venv.py [--check] [LEVEL]

There are two levels. "demo" has what `./scripts/demo` needs: the project, the tools that compile its native core, and
the extra `demo`. "test", the default, adds the remaining packages of constraints.txt to it.

`.venv/ckc_pin-setup` says what .venv was made from: packages on its first line, the native core on its second, and its
level on the third. It reads "unfinished" until the first level is installed, so that what an interrupted start leaves
behind is never taken as good. An interrupted second level leaves the first one as it was. If the native core alone has
changed, it alone is compiled again.
"""

import fcntl
import hashlib
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
STAMP = VENV / "ckc_pin-setup"
CONSTRAINTS = ROOT / "constraints.txt"
PYPROJECT = ROOT / "pyproject.toml"
PACKAGE = ROOT / "ckc_pin"
NATIVE = PACKAGE / "native" / "src"
UNFINISHED = "unfinished\n"
LEVELS = ("demo", "test")  # each adds to the one before
SIZES = {"demo": "1 GB", "test": "3 GB"}  # of .venv on disk; a quarter of it comes over the network


class SetupError(Exception):
    """What went wrong and what to do about it, for a person to read."""


def main() -> None:
    arguments = sys.argv[1:]
    check = "--check" in arguments
    level = next((argument for argument in arguments if argument != "--check"), LEVELS[-1])
    try:
        if level not in LEVELS:
            raise SetupError(f"level {level!r}: expected {' or '.join(LEVELS)}")
        if check:
            sys.exit(0 if up_to_date(level) else 1)
        with one_at_a_time() as lock:
            if not up_to_date(level):
                make(level, lock)
    except SetupError as error:
        sys.exit(f"setup: {error}")
    except OSError as error:
        sys.exit(f"setup: {error}\nsetup: is the folder writable, and is there room for {SIZES[level]}?")
    except KeyboardInterrupt:
        say("interrupted")
        sys.exit(130)


def wanted_stamp() -> tuple[str, str]:
    """Return digests of what .venv depends on, of packages and of the native core.

    They include the place, since a virtual environment cannot be moved.
    """
    packages = digest(f"{sys.version}\n{ROOT}\n", CONSTRAINTS, PYPROJECT, Path(__file__))
    sources = sorted(path for path in NATIVE.rglob("*") if path.is_file())
    native = digest("\n".join(path.relative_to(NATIVE).as_posix() for path in sources), *sources)
    return packages, native


def digest(text: str, *paths: Path) -> str:
    total = hashlib.sha256(text.encode())
    for path in paths:
        total.update(hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()


def read_stamp() -> tuple[str, str, str] | None:
    """Return the stamp's digests and level; None without a .venv that is finished."""
    try:
        packages, native, level = STAMP.read_text().splitlines()
    except (FileNotFoundError, ValueError):
        return None
    return (packages, native, level) if level in LEVELS and (VENV / "bin" / "python").exists() else None


def up_to_date(level: str) -> bool:
    stamp = read_stamp()
    return stamp is not None and stamp[:2] == wanted_stamp() and LEVELS.index(stamp[2]) >= LEVELS.index(level)


@contextmanager
def one_at_a_time() -> Iterator[int]:
    """Hold a lock that the system lets go of when its holder dies, however it dies."""
    with open(ROOT / ".venv.lock", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another start is at work on .venv: waiting for it")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield file.fileno()


def make(level: str, lock: int) -> None:
    packages, native = wanted_stamp()
    stamp = read_stamp()
    if stamp is None or stamp[0] != packages:
        clear_away()
        base = LEVELS[0]
        say(f"making .venv with Python {sys.version.split()[0]}: once only, a minute or more, {SIZES[level]}")
        VENV.mkdir()
        STAMP.write_text(UNFINISHED)
        with removed_on_failure():
            run_quietly(lock, "venv", [sys.executable, "-I", "-m", "venv", str(VENV)])
            install(base, lock)
            compile_native(lock)
    else:
        base = stamp[2]
        if stamp[1] != native:
            STAMP.write_text(UNFINISHED)
            with removed_on_failure():
                compile_native(lock)
    STAMP.write_text(f"{packages}\n{native}\n{base}\n")
    for added in LEVELS[LEVELS.index(base) + 1 : LEVELS.index(level) + 1]:
        say(f"adding what level {added!r} needs: once only, a minute or more, {SIZES[added]} in all")
        # An interrupted start may have left some of these packages behind, whole or not: install them again.
        install(added, lock, "--no-deps", "--ignore-installed")
        STAMP.write_text(f"{packages}\n{native}\n{added}\n")
    say("done")


def install(level: str, lock: int, *options: str) -> None:
    """Install the packages that a level adds."""
    entries = locked_packages(level)
    file = VENV / f"ckc_pin-{level}.txt"
    file.write_text("".join(entries.values()))
    # Wheels only: building a source package would fetch a build backend whose hash nobody checks.
    hashed = ["--require-hashes", "--only-binary=:all:", "--progress-bar=off", "-r", str(file)]
    run_with_progress(lock, "pip", [*pip(), *options, *hashed], total=len(entries))


def locked_packages(level: str) -> dict[str, str]:
    """Return the entries of constraints.txt that a level adds, by name of the package."""
    entries = {}
    dependencies: dict[str, set[str]] = {}
    for entry in re.findall(r"^[a-z0-9][^ ]*==.*\n(?: .*\n)*", CONSTRAINTS.read_text(), re.MULTILINE):
        name = package_name(entry)
        entries[name] = entry
        # After its hashes, an entry lists the packages that need it: "# via NAME", or "# via" with one NAME a line.
        for dependent in re.findall(r"^ +# +(?:via +)?(?!via$)(\S+)$", entry, re.MULTILINE):
            dependencies.setdefault(dependent, set()).add(name)
    needed: set[str] = set()
    queue = [package_name(requirement) for requirement in demo_requirements()]
    while queue:
        name = queue.pop()
        if name not in needed:
            needed.add(name)
            queue += dependencies.get(name, ())
    if missing := needed - entries.keys():
        raise SetupError(f"{CONSTRAINTS}: {', '.join(sorted(missing))} of {PYPROJECT} missing: run ./scripts/lock")
    return {name: entry for name, entry in entries.items() if (name in needed) == (level == "demo")}


def demo_requirements() -> list[str]:
    """Return what pyproject.toml requires to build the project and to run the demo."""
    content = tomllib.loads(PYPROJECT.read_text())
    project = content["project"]
    extra: list[str] = project["optional-dependencies"]["demo"]
    return [*project["dependencies"], *content["build-system"]["requires"], *extra]


def package_name(requirement: str) -> str:
    """Return the normalized name of the package that a requirement names."""
    name = re.split(r"[^A-Za-z0-9._-]", requirement, maxsplit=1)[0]
    return re.sub(r"[-_.]+", "-", name).lower()


def compile_native(lock: int) -> None:
    say("installing ckc_pin: its native core is compiled, a minute or more")
    editable = ["--no-deps", "--no-build-isolation", "--no-index", "--editable", str(ROOT)]
    run_quietly(lock, "pip", [*pip(), *editable])
    # The first start compiles nothing, and neither do later ones where Python is told to write no bytecode.
    run_quietly(lock, "compileall", [str(VENV / "bin" / "python"), "-I", "-m", "compileall", "-q", str(PACKAGE)])


def pip() -> list[str]:
    return [str(VENV / "bin" / "python"), "-I", "-m", "pip", "--disable-pip-version-check", "install"]


@contextmanager
def removed_on_failure() -> Iterator[None]:
    try:
        yield
    except BaseException:
        with suppress(OSError):
            remove_venv()
        raise


def clear_away() -> None:
    """Remove an outdated or unfinished .venv of ours, never one that somebody else made."""
    if VENV.is_symlink() or (VENV.exists() and not STAMP.exists() and any(VENV.iterdir())):
        raise SetupError(f"{VENV} was not made by this script: move it away and start again.")
    if VENV.exists():
        say("the .venv that is there is unfinished or out of date")
        remove_venv()


def remove_venv() -> None:
    """Remove the stamp last, so that what an interrupted removal leaves behind is still known as ours."""
    STAMP.write_text(UNFINISHED)
    for entry in VENV.iterdir():
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        elif entry != STAMP:
            entry.unlink()
    shutil.rmtree(VENV)


def run_with_progress(lock: int, what: str, command: list[str], total: int) -> None:
    """Run pip; on a terminal tell which of its `total` packages it is at."""
    at = 0

    def progress(line: str) -> None:
        nonlocal at
        word, _, rest = line.partition(" ")
        if word in ("Collecting", "Ignoring"):  # "Ignoring": for other systems or versions of Python
            at += 1
            show(f"fetching {at} of {total}: {rest.split('==')[0].split(':')[0]}")
        elif line.startswith("Installing collected packages"):
            show("unpacking")

    run_quietly(lock, what, command, progress)


def run_quietly(lock: int, what: str, command: list[str], on_line: Callable[[str], None] = lambda line: None) -> None:
    """Run a command that is heard only when it fails.

    It holds the lock as well: should we be killed, nobody touches .venv while it still writes there.
    """
    lines = []
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        pass_fds=(lock,),
    ) as process:
        try:
            for line in process.stdout:
                lines.append(line.rstrip())
                on_line(line)
        except BaseException:
            process.terminate()
            process.wait()
            raise
        finally:
            show("")
    if process.returncode != 0:
        chatter = ("Collecting ", "Downloading ", "Using cached ", "Ignoring ")
        heard = [f"    {line}" for line in lines if not line.lstrip().startswith(chatter)][-12:]
        stamp = read_stamp()
        result = f".venv stays at level {stamp[2]!r}" if stamp else ".venv is not made"
        remedy = f"setup: it needs the network and {SIZES[LEVELS[-1]]} of disk; when the cause is gone, start again."
        raise SetupError("\n".join([f"{what} failed, {result}:", *heard, remedy]))


def say(text: str) -> None:
    print(f"setup: {text}", file=sys.stderr, flush=True)


def show(text: str) -> None:
    """Rewrite the last line of a terminal; nothing elsewhere."""
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns - 1
        print(f"\r\x1b[K{text[:width]}", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
