# Sourced by the other scripts: find_python sets $python to a CPython >= 3.11 that can make virtual environments,
# or says what to install. PYTHON=/path/to/python names one, and then no other is tried.

# A PYTHONPATH (robotics set-ups like to export one) would put other versions before ours.
unset PYTHONPATH PYTHONHOME

# What is said of an interpreter: its version, then "ok" or what is wrong with it.
probe='
import sys
verdict = "ok"
if sys.version_info < (3, 11):
    verdict = "too old"
elif sys.implementation.name != "cpython":
    verdict = "not CPython"
else:
    try:
        import ensurepip
        from venv import EnvBuilder
    except ImportError:
        verdict = "without its venv module"
print("%d.%d.%d %s" % (sys.version_info[0], sys.version_info[1], sys.version_info[2], verdict))
'

find_python() {
    seen=
    without_venv=
    if [ -n "${PYTHON:-}" ]; then
        try_python "$PYTHON" && return
        [ -n "$seen" ] || seen="
    $PYTHON (from the environment variable PYTHON) does not start"
    else
        for candidate in python3.13 python3.12 python3.11 python3 python; do
            try_python "$candidate" && return
        done
    fi
    explain_python >&2
    exit 1
}

try_python() {
    found=$(command -v "$1") || return 1
    answer=$("$found" -c "$probe" 2>/dev/null) || return 1
    version=${answer%% *}
    verdict=${answer#* }
    if [ "$verdict" = ok ]; then
        python=$found
        return 0
    fi
    [ "$verdict" = "without its venv module" ] && without_venv=${without_venv:-${version%.*}}
    seen="$seen
    $1 is Python $version, $verdict"
    return 1
}

explain_python() {
    echo "ckc_pin needs Python 3.11 or newer with its venv module. Found:${seen:- none}"
    echo "To install it:"
    if [ -n "$without_venv" ]; then
        echo "    Debian, Ubuntu:  sudo apt install python$without_venv-venv"
    else
        echo "    Debian, Ubuntu:  sudo apt install python3 python3-venv"
        echo "                     (where python3 is older: python3.11 python3.11-venv)"
    fi
    echo "    Fedora:          sudo dnf install python3"
    echo "    macOS:           brew install python"
    echo "An interpreter elsewhere:  PYTHON=/path/to/python3 $0"
}
