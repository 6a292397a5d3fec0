"""Make .venv: exact versions, checked hashes, the project editable. Standard library only.

`.venv/ckc_pin-setup` says what .venv was made from, packages on its first line and the native core on its second. It
reads "unfinished" until everything is installed, so that what an interrupted start leaves behind is never taken as
good. Where the native core alone has changed, it alone is compiled again.
"""

import fcntl
import hashlib
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
STAMP = VENV / "ckc_pin-setup"
CONSTRAINTS = ROOT / "constraints.txt"
PACKAGE = ROOT / "ckc_pin"
NATIVE = PACKAGE / "native" / "src"
UNFINISHED = "unfinished\n"
SIZE = "1.5 GB"  # on disk; a quarter of it comes over the network


class SetupError(Exception):
    """What went wrong and what to do about it, for a person to read."""


def main() -> None:
    if "--check" in sys.argv:
        sys.exit(0 if up_to_date() else 1)
    try:
        with one_at_a_time() as lock:
            if not up_to_date():
                make(lock)
    except SetupError as error:
        sys.exit(f"setup: {error}")
    except OSError as error:
        sys.exit(f"setup: {error}\nsetup: is the folder writable, and is there room for {SIZE}?")
    except KeyboardInterrupt:
        say("interrupted")
        sys.exit(130)


def wanted_stamp() -> str:
    """Everything that .venv depends on; the place too, since a virtual environment cannot be moved."""
    packages = digest(f"{sys.version}\n{ROOT}\n", CONSTRAINTS, ROOT / "pyproject.toml", Path(__file__))
    sources = sorted(path for path in NATIVE.rglob("*") if path.is_file())
    native = digest("\n".join(path.relative_to(NATIVE).as_posix() for path in sources), *sources)
    return f"{packages}\n{native}\n"


def digest(text: str, *paths: Path) -> str:
    total = hashlib.sha256(text.encode())
    for path in paths:
        total.update(hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()


def up_to_date() -> bool:
    try:
        return STAMP.read_text() == wanted_stamp() and (VENV / "bin" / "python").exists()
    except FileNotFoundError:
        return False


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


def make(lock: int) -> None:
    packages = wanted_stamp().splitlines()[0]
    if not (STAMP.exists() and STAMP.read_text().startswith(packages)):
        clear_away()
        say(f"making .venv with Python {sys.version.split()[0]}: once only, a minute or more, {SIZE}")
        VENV.mkdir()
        STAMP.write_text(UNFINISHED)
        with removed_on_failure():
            run_quietly(lock, "venv", [sys.executable, "-I", "-m", "venv", str(VENV)])
            # Wheels only: building a source package would fetch a build backend whose hash nobody checks.
            hashed = ["--require-hashes", "--only-binary=:all:", "--progress-bar=off", "-r", str(CONSTRAINTS)]
            run_with_progress(lock, "pip", [*pip(), *hashed])
    STAMP.write_text(UNFINISHED)
    say("installing ckc_pin: its native core is compiled, two minutes or more")
    with removed_on_failure():
        editable = ["--no-deps", "--no-build-isolation", "--no-index", "--editable", str(ROOT)]
        run_quietly(lock, "pip", [*pip(), *editable])
        # The first start compiles nothing, and neither do later ones where Python is told to write no bytecode.
        run_quietly(lock, "compileall", [str(VENV / "bin" / "python"), "-I", "-m", "compileall", "-q", str(PACKAGE)])
        STAMP.write_text(wanted_stamp())
    say("done")


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


def run_with_progress(lock: int, what: str, command: list[str]) -> None:
    """Run pip; on a terminal tell which package it is at."""
    total = sum("==" in line for line in CONSTRAINTS.read_text().splitlines() if not line.startswith("#"))
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
        remedy = f"setup: it needs the network and {SIZE} of disk; when the cause is gone, start again."
        raise SetupError("\n".join([f"{what} failed, .venv is not made:", *heard, remedy]))


def say(text: str) -> None:
    print(f"setup: {text}", file=sys.stderr, flush=True)


def show(text: str) -> None:
    """Rewrite the last line of a terminal; nothing elsewhere."""
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns - 1
        print(f"\r\x1b[K{text[:width]}", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
