"""Shared fixtures: a deterministic hypothesis profile, the two five-bars, caches of compiled terms and of runs."""

from __future__ import annotations

import fcntl
import gc
import os
import pickle
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator
from functools import cache, wraps
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers

from ckc_pin import Mechanism, Run, load, simulate
from ckc_pin.analysis.map import loci
from ckc_pin.codegen import compiler, library
from ckc_pin.codegen.library import compile_terms
from tests.analytic.five_bar import AS_PRINTED, FIVE_BAR, FiveBar

settings.register_profile(
    "ckc_pin",
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=20,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("ckc_pin")
# Hypothesis would also draw constants from the source of all modules that the process has imported. Examples would then
# depend on the tests that ran before, and every worker would parse a thousand modules.
pytest.MonkeyPatch().setattr(providers, "_get_local_constants", lambda: providers._local_constants)

# A shell ignores SIGINT for background jobs, and child processes would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)


# The files that take longest, of the seconds of all tests about three quarters. They are begun first, so that all
# workers end at about the same time.
SLOW_FILES = (
    "docs/test_snippets.py",
    "browser/test_explore_by_hand.py",
    "identification/test_torques.py",
    "browser/test_explore_page.py",
    "examples/test_examples.py",
    "docs/test_site.py",
    "codegen/test_export_fmu.py",
    "browser/test_player.py",
    "ensembles/test_sweep.py",
    "codegen/test_export_c.py",
    "contract/test_experiments.py",
    "browser/test_explore_dragging.py",
    "optimization/test_free_path.py",
    "identification/test_motions.py",
    "browser/test_playback.py",
    "contract/test_cli_signals.py",
    "optimization/test_smooth_paths.py",
    "optimization/test_point_to_point.py",
    "contract/test_report_command.py",
    "analytic/test_desired_motions.py",
    "identification/test_calibration.py",
    "sensitivity/test_compiled_terms.py",
    "browser/test_explore_connection.py",
    "fuzz/test_fuzz.py",
    "analytic/test_map.py",
    "property/test_dynamics.py",
    "optimization/test_along_path.py",
    "codegen/test_far_masses.py",
    "optimization/test_state_limits.py",
    "contract/test_scene_from_python.py",
    "regression/test_ivp.py",
    "identification/test_excitation.py",
    "sensitivity/test_named_parameters.py",
    "codegen/test_derivatives.py",
    "analytic/test_derivatives.py",
    "analytic/test_sections.py",
    "codegen/test_c_source.py",
    "analytic/test_prescribed.py",
    "ensembles/test_damaged_results.py",
    "optimization/test_phases.py",
    "codegen/test_fmu_stops.py",
    "identification/test_motion_errors.py",
    "codegen/test_library.py",
    "analysis/test_work_precision.py",
    "sensitivity/test_sensitivities.py",
    "contract/test_figures.py",
    "contract/test_figures_manners.py",
    "contract/test_run_warnings.py",
    "docs/test_pictures.py",
    "codegen/test_compiled.py",
    "optimization/test_total_power.py",
    "property/test_closure.py",
    "contract/test_names.py",
    "optimization/test_state_functions.py",
    "sensitivity/test_control.py",
    "explorer/test_live_run.py",
    "joints/test_mechanisms.py",
    "regression/test_inverse_forward.py",
    "analytic/test_workspace.py",
    "analytic/test_stability.py",
    "identification/test_smoothing.py",
    "analytic/test_parameter_map.py",
    "contract/test_sensors.py",
    "optimization/test_dry_friction.py",
    "ensembles/test_interrupt.py",
    "sensitivity/test_couplings.py",
)

# Flags of the C compiler: as users have them, and without optimization
OPTIMIZED = compiler.FLAGS
QUICK = ("-O0", *(flag for flag in OPTIMIZED if not flag.startswith("-O")))
CURVE_STEP = loci.CURVE_STEP  # of curves in singularity maps, as users have it
REFERENCES = {"five_bar": FIVE_BAR, "five_bar_as_printed": AS_PRINTED}

Pair = tuple[Mechanism, FiveBar]


def pytest_configure(config: pytest.Config) -> None:
    """Keep the order of files; pytest-xdist would begin with the files that have most tests."""
    config.option.loadscopereorder = False
    gc.disable()


def pytest_collection_finish() -> None:
    """Collect garbage from now on, but not among the tests, which would take a quarter of the time to collect them.

    Python's own thresholds, 700, 10 and 10, take tests of figures 5 % more processor time, and tests of runs 1 % more.
    """
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
    gc.enable()


@pytest.hookimpl(wrapper=True, optionalhook=True)
def pytest_xdist_auto_num_workers() -> Generator[None, int, int]:
    """Use one worker more than there are cores, because many tests wait for a browser or another process."""
    return (yield) + 1


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the slow files."""
    place = {Path(__file__).parent / file: k for k, file in enumerate(SLOW_FILES)}
    items.sort(key=lambda item: place.get(item.path, len(place)))


def assert_close(ours: Any, theirs: Any, tolerance: float, *, relative: bool = False) -> None:
    """Check the largest difference of two arrays; `relative`: the tolerance is relative to the largest of `theirs`."""
    ours, theirs = np.broadcast_arrays(np.asarray(ours, dtype=float), np.asarray(theirs, dtype=float))
    limit = tolerance * np.abs(theirs).max(initial=0.0) if relative else tolerance
    gap = np.abs(ours - theirs)
    if not gap.max(initial=0.0) <= limit:
        at = tuple(map(int, np.unravel_index(np.argmax(gap), gap.shape)))
        raise AssertionError(f"off by {gap[at]:.3g}, allowed {limit:.3g}: {ours[at]} for {theirs[at]} at {at}")


def remember(compute: Callable[..., Any]) -> Callable[..., Any]:
    """Compute a reference once per process for equal arguments; arrays are compared by their content."""
    results: dict[bytes, Any] = {}

    @wraps(compute)
    def recall(*arguments: Any) -> Any:
        key = pickle.dumps(arguments)
        if key not in results:
            results[key] = compute(*arguments)
        return results[key]

    return recall


@pytest.fixture(scope="session", autouse=True)
def no_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Make the cache of compiled terms empty and unwritable, by a file at the path of its folder."""
    cache = tmp_path_factory.mktemp("no_cache")
    (cache / "ckc_pin").touch()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        yield


@pytest.fixture(scope="session", autouse=True)
def quick_compiler() -> Iterator[None]:
    """Compile terms with -O0, in a seventh of the time of -O2, for the same numbers. tests/codegen uses -O2."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "FLAGS", QUICK)
        yield


@pytest.fixture(scope="session", autouse=True)
def few_points_of_curves() -> Iterator[None]:
    """Compute a quarter of the points of curves in singularity maps, which are as accurate."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loci, "CURVE_STEP", 0.15)
        yield


def forget_process_folder(patch: pytest.MonkeyPatch) -> None:
    """Let the process find no terms that earlier tests have compiled without a cache."""
    patch.setattr(library, "process_folder", cache(library.process_folder.__wrapped__))


def _shared_folder(tmp_path_factory: pytest.TempPathFactory, name: str) -> Path:
    """Return a folder that all workers of pytest-xdist have in common."""
    folder = tmp_path_factory.getbasetemp()
    folder = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / name
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def writable_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a cache folder for tests that compile terms. Other tests do not use it. All workers share it."""
    return _shared_folder(tmp_path_factory, "writable_cache")


@pytest.fixture(scope="session")
def compiled_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a cache folder with compiled terms of the mechanisms that behaviour is tested with.

    All workers share it. Each of them starts with another mechanism, and waits if another worker is compiling one.
    """
    folder, worker = _shared_folder(tmp_path_factory, "compiled"), os.environ.get("PYTEST_XDIST_WORKER", "")
    names = deque(["five_bar", "four_bar", "n_four_bar", "slider_crank"])
    names.rotate(2 * int(worker.removeprefix("gw") or 0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        forget_process_folder(patch)
        for name in names:
            with (folder / f"{name}.lock").open("w", encoding="utf-8") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                compile_terms(load(name))
    return folder


@pytest.fixture(params=["pinocchio", "generated"])
def either_terms(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Run a test with Pinocchio's terms and with compiled terms."""
    if request.param == "generated":
        monkeypatch.setenv("XDG_CACHE_HOME", str(request.getfixturevalue("compiled_cache")))
    return str(request.param)


@pytest.fixture(scope="session", params=REFERENCES)
def pair(request: pytest.FixtureRequest) -> Pair:
    """Return a shipped five-bar and its NumPy reference, for both readings of Table I."""
    return load(request.param), REFERENCES[request.param]


@pytest.fixture(scope="session")
def five_bar() -> Pair:
    """Return the five-bar of the default reading of Table I and its NumPy reference."""
    return load("five_bar"), FIVE_BAR


@pytest.fixture(scope="session")
def run() -> Callable[..., Run]:
    """Return a cached `simulate`: run(scene, formulation="dae", solver__rtol=1e-10) is computed once."""
    done: dict[tuple[Any, ...], Run] = {}

    def run(scene: str, **overrides: Any) -> Run:
        terms = os.environ.get("XDG_CACHE_HOME", "")  # compiled terms are part of the key
        key = (terms, scene, *sorted((name, repr(value)) for name, value in overrides.items()))
        if key not in done:
            done[key] = simulate(scene, {name.replace("__", "."): value for name, value in overrides.items()})
        return done[key]

    return run
