"""Puts this folder on the path, so that tests in every room share `cells`; and the fixtures they begin with."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy comes: the tests' own workers are enough

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as shells leave it for what they run in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest
from cells import CellFolder
from compiled_once import compile_each_kernel_once
from hypothesis import HealthCheck, settings
from nursery import NURSERY
from skip_budget import over_budget
from xdist.scheduler.loadscope import LoadScopeScheduling

from coupole.kernels.kept_code import kept_in
from sim.world import client

pytest_plugins = ["coupole.testing"]
os.environ.setdefault("NUMBA_CACHE_DIR", str(kept_in()))  # also of commands whose home is a test's folder
compile_each_kernel_once()
client._launch = NURSERY.start  # type: ignore[assignment] # for what runs in the tests' own process

unhurried: Any = {
    "deadline": None,
    "suppress_health_check": [HealthCheck.too_slow],
}  # no test asserts wall-clock speed
settings.register_profile("coupole", max_examples=30, **unhurried)
settings.register_profile("coupole at full scale", max_examples=500, **unhurried)
settings.load_profile("coupole")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--full", action="store_true", help="full scale: minutes to an hour instead of seconds")
    parser.addoption("--account", metavar="FOLDER", help="for tools/where_seconds_go.py: what each test spends")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "full: at full scale only; left out without --full")
    if config.getoption("--full"):
        from coupole.testing import RobotConformance

        settings.load_profile("coupole at full scale")
        RobotConformance.poses, RobotConformance.stops = 200, 40
    if folder := config.getoption("--account"):
        from time_account import Account

        config.pluginmanager.register(Account(Path(folder)))


COMPILE_LONGEST = ("tests/calibration/test_corner_fit.py", "tests/runs/test_reflectance_of_other_runs.py")
"""Their kernels take ten seconds and more to compile: they come first, so that not every worker does that when
others want them."""


WAITING = ("tests/runs/", "tests/faults/", "tests/conformance/")
"""Most of the time tests in these folders wait for the clocks of worlds; those in all others compute."""

WAITED_BY = 0.75
"""Share of the tests after which no module that waits begins."""


def spread(items: list[pytest.Item]) -> list[pytest.Item]:
    """The tests with the modules of each folder that waits, and of all that compute, in equal shares: workers that
    all wait at one time leave the machine idle. Those that wait come sooner, as some of them take minutes."""
    modules: dict[str, list[pytest.Item]] = {}
    for item in items:
        modules.setdefault(item.nodeid.partition("::")[0], []).append(item)
    kinds: dict[str, list[str]] = {}
    for name in modules:
        kinds.setdefault(next((folder for folder in WAITING if name.startswith(folder)), ""), []).append(name)
    place = {
        name: (WAITED_BY if folder else 1.0) * index / len(kind)
        for folder, kind in kinds.items()
        for index, name in enumerate(kind)
    }
    return [item for name in sorted(modules, key=place.__getitem__) for item in modules[name]]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Order the tests, and leave out what is for `--full` alone."""
    items[:] = sorted(spread(items), key=lambda item: not item.nodeid.startswith(COMPILE_LONGEST))
    if config.getoption("--full"):
        return
    left_out = [item for item in items if item.get_closest_marker("full")]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if not item.get_closest_marker("full")]


@pytest.fixture(autouse=True)
def _leaves_signals_as_they_were() -> Generator[None]:
    """A command ignores signals when it exits. If that stays so in a worker, each process that a later test starts
    ignores Ctrl-C too. (Other people's libraries set handlers of their own.)"""
    before = signal.getsignal(signal.SIGINT)
    yield
    left = signal.signal(signal.SIGINT, before)
    assert left is not signal.SIG_IGN or before is signal.SIG_IGN, (
        "the test leaves Ctrl-C ignored: use `cells.here`"
    )


def pytest_collection_finish() -> None:
    """The garbage collector need not go through half a million objects of the tests' modules, time and again."""
    gc.freeze()


TOGETHER = ("tests/exchange/page/", "tests/reflectance/test_picture", "tests/runs/test_texel")
"""Beginnings of the names of tests that share a browser, or a result: one worker has them all."""


class _Scopes(LoadScopeScheduling):
    """Modules and classes, each for one worker."""

    def _split_scope(self, nodeid: str) -> str:
        shared_scope = next((begin for begin in TOGETHER if nodeid.startswith(begin)), None)
        return shared_scope or super()._split_scope(nodeid)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadScopeScheduling | None:
    return _Scopes(config, log) if config.getoption("dist") == "loadscope" else None


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Without garbage collection. A finalizer that parses Python while pytest parses the source of a failure makes
    that a SystemError, which ends the whole run (CPython 3.11, "AST constructor recursion depth mismatch")."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        return (yield)
    finally:
        if was_enabled:
            gc.enable()


SKIPPED_TOO_MUCH = 10
"""Exit code of a run that skipped what it had to run; none of pytest's own, so that nobody runs it once more."""
_skipped: dict[str, str] = {}


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.skipped and isinstance(report.longrepr, tuple):
        _skipped[report.nodeid] = str(report.longrepr[2])


def pytest_collectreport(report: pytest.CollectReport) -> None:
    if report.skipped and isinstance(report.longrepr, tuple):
        _skipped[report.nodeid] = str(report.longrepr[2])


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """A run that skipped what it had to run has failed."""
    if hasattr(session.config, "workerinput"):
        return
    if wrong := over_budget(_skipped):
        session.exitstatus = SKIPPED_TOO_MUCH
        print("\nskipped, but had to run on this machine:", *wrong, sep="\n  ")


@pytest.fixture(scope="session")
def scale(request: pytest.FixtureRequest) -> Callable[[int, int], int]:
    """`scale(small, full)`: how many of something to test, with `--full` or without."""
    full = bool(request.config.getoption("--full"))
    return lambda small, whole: whole if full else small


@pytest.fixture
def cell(tmp_path: Path) -> CellFolder:
    """A small simulated cell, with a folder of its own."""
    return CellFolder(tmp_path)
