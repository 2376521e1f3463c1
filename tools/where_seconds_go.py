"""Account of where the seconds of the tests go, by room (a folder of tests) and by kind.

`python tools/where_seconds_go.py [--workers N] [--show] [PATH ...]` runs the tests (all, or these paths) with
pytest's `--account`. It prints two tables and the most expensive tests. The counts are stored in
`runs/where_seconds_go`; `--show` prints them again. Unknown options go to pytest.

CPU seconds, of all processes together:

- *starts* (calls of `Popen`), *imports*, *compile* (numba) and *load* (kernels from numba's cache) are counted
  inside of the tests' process and of what its nursery forks: worlds and most commands.
- *world*: the rest of simulated worlds.
- *browser*: Chromium, its driver, and the calls to it.
- *mitsuba*: the tests' process during `render` and `load_dict`.
- *python*: separate interpreters, with all that they do, including imports. They are not divided further.
- *others*: other processes.
- *work*: the rest of the tests' process and of forked commands.

The room "(workers)" belongs to no test. It has the start of the tests' processes and of their nurseries, the
collection of the tests and, in *others*, all CPU time of the system that is not accounted for elsewhere.

Wall seconds of the tests' process: on a core (*cpu*), waiting for a core (*queue*), blocked while processes of
the test computed (*processes*: at most their CPU seconds), and blocked otherwise: in the *browser*, *paced* (the
test has a world or a command), or *still*. With several workers the rooms' wall seconds run side by side.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import resource
import shutil
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
KEPT = ROOT / "runs/where_seconds_go"
DEAREST = 30
WORKERS = "(workers)"

COUNTED = {
    "imports": "imports",
    "numba, compiling": "compile",
    "numba, loading": "load",
    "start of processes": "starts",
    "waiting for processes": "work",
    "browser": "browser",
    "Mitsuba": "mitsuba",
}
"""Kinds of `tests/kinds_of_time.py`, and their columns."""
CPU = ("starts", "imports", "compile", "load", "world", "browser", "mitsuba", "python", "others", "work")
WALL = ("cpu", "queue", "processes", "browser", "paced", "still")
FORKS = ("world", "command")
PR_SET_CHILD_SUBREAPER = 36


@dataclass
class Spent:
    """Seconds by kind."""

    cpu_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    wall_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    tests: int = 0

    def add(self, addend: Spent) -> None:
        add_up(self.cpu_s, addend.cpu_s)
        add_up(self.wall_s, addend.wall_s)
        self.tests += addend.tests


def add_up(into: dict[str, float], more: Mapping[str, float]) -> None:
    """Add seconds by kind to those in `into`."""
    for kind, seconds in more.items():
        into[kind] += seconds


@dataclass
class Process:
    """A process that a test started, or that the nursery forked for such a process."""

    name: str
    test: str
    cpu_s: float = 0.0
    kinds: dict[str, float] = field(default_factory=dict)

    @property
    def column(self) -> str:
        if self.name in FORKS:
            return "world" if self.name == "world" else "work"
        if self.name.startswith("chrom"):
            return "browser"
        return "python" if self.name.startswith(("python", "coupole")) else "others"


# -- counting ---------------------------------------------------------------------------------------------


def count(paths: list[str], workers: int) -> int:
    """Run the tests and store the seconds that they spend; return pytest's exit code."""
    shutil.rmtree(KEPT, ignore_errors=True)
    KEPT.mkdir(parents=True)
    # a process that outlives its parent is waited for here
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    worker_options = ["-n", str(workers), "--dist", "loadscope", "--no-loadscope-reorder"] if workers > 1 else []
    command = [sys.executable, "-m", "pytest", *worker_options, f"--account={KEPT}", *paths]
    # like tools/test: otherwise hundreds of processes would each compile every module again, and waiting threads
    # would take the other workers' cores
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment["OMP_WAIT_POLICY"] = "passive"
    tests = subprocess.Popen(command, cwd=ROOT, env=environment)
    code = 0
    with (KEPT / "outside.jsonl").open("w") as file:
        for pid, name, status, cpu_s in bury_children():
            if pid == tests.pid:
                code = tests.returncode = os.waitstatus_to_exitcode(status)
            else:
                file.write(json.dumps({"what": "ended", "pid": pid, "name": name, "cpu": cpu_s}) + "\n")
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    end_time = f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    about = {"ended": end_time, "arguments": paths, "workers": workers, "code": code}
    (KEPT / "about.json").write_text(json.dumps({**about, "cpu_s": usage.ru_utime + usage.ru_stime}))
    return code


def bury_children() -> Iterator[tuple[int, str, int, float]]:
    """Yield each child, and each process that has lost its parent, when it ends: pid, name, status, CPU
    seconds."""
    while True:
        try:
            exit_info = os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOWAIT)
        except ChildProcessError:
            return
        assert exit_info is not None
        name = Path(f"/proc/{exit_info.si_pid}/comm").read_text().strip()
        pid, status, usage = os.wait4(exit_info.si_pid, 0)
        yield pid, name, status, usage.ru_utime + usage.ru_stime


# -- adding up --------------------------------------------------------------------------------------------


def lines() -> list[dict[str, Any]]:
    return [json.loads(line) for path in sorted(KEPT.glob("*.jsonl")) for line in path.read_text().splitlines()]


def processes(lines_read: list[dict[str, Any]]) -> dict[int, Process]:
    """Return the processes of tests, by pid; a nursery belongs to no test, whichever test was its first."""
    nurseries = {line["pid"] for line in lines_read if line["what"] == "nursery"}
    process_of_pid = {
        line["pid"]: Process(line["name"], line["test"])
        for line in lines_read
        if line["what"] == "process" and line["test"] and line["pid"] not in nurseries
    }
    for line in lines_read:  # the world of a command belongs to the command's test
        if line["what"] == "fork" and line["parent"] in process_of_pid:
            process_of_pid[line["pid"]] = Process("world", process_of_pid[line["parent"]].test)
    for line in lines_read:
        if (process := process_of_pid.get(line.get("pid", 0))) is None:
            continue
        if line["what"] == "ended":
            process.cpu_s = line["cpu"]
        if line["what"] == "kinds of process":
            process.kinds = columns(line["kinds"]["cpu_s"])
    return process_of_pid


def columns(kinds: dict[str, float]) -> dict[str, float]:
    """Return CPU seconds by column, from the counts by kind."""
    seconds_of_column: dict[str, float] = defaultdict(float)
    for kind, seconds in kinds.items():
        seconds_of_column[COUNTED[kind]] += seconds
    return dict(seconds_of_column)


def add_cpu(seconds_used: Spent, total_s: float, inside: dict[str, float], rest: str) -> None:
    """Add the seconds that were counted inside a process, and under `rest` the remainder of the seconds that it
    used."""
    seconds_of_kind = {kind: seconds for kind, seconds in inside.items() if kind != "work"}
    add_up(seconds_used.cpu_s, seconds_of_kind)
    seconds_used.cpu_s[rest] += max(0.0, total_s - sum(seconds_of_kind.values()))


def of_tests(lines_read: list[dict[str, Any]]) -> tuple[dict[str, Spent], Spent]:
    """Return seconds by test, and those that belong to no test."""
    by_test: dict[str, Spent] = defaultdict(Spent)
    nobody = Spent()
    processes_of_test: dict[str, list[Process]] = defaultdict(list)
    for process in processes(lines_read).values():
        processes_of_test[process.test].append(process)
    for line in lines_read:
        if line["what"] == "start":
            nobody.cpu_s["imports"] += line["cpu_s"]
        if line["what"] == "nursery":
            add_cpu(nobody, line["cpu"], columns(line["kinds"]["cpu_s"]), "imports")
        if line["what"] not in ("test", "collection", "between"):
            continue
        account = by_test[line["test"]] if line["test"] else nobody
        add_cpu(account, line["cpu"], columns(line["kinds"]["cpu_s"]), "work")
        add_up(account.wall_s, wall(line, processes_of_test[line["test"]]))
        account.tests += line["what"] == "test"
    for test, children in processes_of_test.items():
        for process in children:
            add_cpu(by_test[test], process.cpu_s, process.kinds, process.column)
    return by_test, nobody


def wall(line: dict[str, Any], test_processes: list[Process]) -> dict[str, float]:
    """Return the wall seconds of a test by kind; `test_processes` are its processes."""
    blocked_s = max(0.0, line["wall"] - line["main"] - line["queued"])
    kinds = line["kinds"]
    browser = min(blocked_s, max(0.0, kinds["wall_s"].get("browser", 0.0) - kinds["cpu_s"].get("browser", 0.0)))
    processes_s = min(
        blocked_s - browser, sum(process.cpu_s for process in test_processes if process.column != "browser")
    )
    rest = blocked_s - browser - processes_s
    has_world = any(process.name in FORKS for process in test_processes)
    return {
        "cpu": line["main"],
        "queue": line["queued"],
        "processes": processes_s,
        "browser": browser,
        "paced" if has_world else "still": rest,
    }


# -- printing ---------------------------------------------------------------------------------------------


def table(title: str, kinds: tuple[str, ...], rows: list[tuple[str, dict[str, float], int]]) -> None:
    """Print the seconds of each row by kind, the largest row first, and of all rows."""
    print(f"\n{title:28} tests    all" + "".join(f"{kind:>10}" for kind in kinds))
    whole: dict[str, float] = defaultdict(float)
    for name, seconds, tests in sorted(rows, key=lambda row: -sum(row[1].values())):
        add_up(whole, seconds)
        print(
            f"{name:28}{tests:6}{sum(seconds.values()):7.1f}" + "".join(f"{seconds[kind]:10.1f}" for kind in kinds)
        )
    total = "".join(f"{whole[kind]:10.1f}" for kind in kinds)
    print(f"{'all':28}{sum(row[2] for row in rows):6}{sum(whole.values()):7.1f}{total}")


def show() -> None:
    """Print the last counts."""
    about = json.loads((KEPT / "about.json").read_text())
    by_test, nobody = of_tests(lines())
    rooms: dict[str, Spent] = defaultdict(Spent)
    for test, account in by_test.items():
        rooms["/".join(test.split("/")[1:2])].add(account)
    rooms[WORKERS] = nobody
    accounted_s = sum(sum(account.cpu_s.values()) for account in rooms.values())
    nobody.cpu_s["others"] += max(0.0, about["cpu_s"] - accounted_s)
    selection = " ".join(about["arguments"]) or "all tests"
    print(f"{selection}, {about['workers']} at a time, ended {about['ended']}, exit code {about['code']}:")
    print(f"{about['cpu_s']:.0f} s of CPU, of which {accounted_s:.0f} s are accounted for")
    for title, kinds in (("CPU seconds", CPU), ("wall seconds", WALL)):
        of = "cpu_s" if kinds is CPU else "wall_s"
        table(title, kinds, [(room, getattr(account, of), account.tests) for room, account in rooms.items()])
    print(f"\nthe {DEAREST} dearest tests: CPU s, wall s, what most of the CPU was")
    for test, account in sorted(by_test.items(), key=lambda one: -sum(one[1].cpu_s.values()))[:DEAREST]:
        dearest = Counter(account.cpu_s).most_common(3)
        most = ", ".join(f"{kind} {seconds:.1f}" for kind, seconds in dearest if seconds >= 0.05)
        print(f"{sum(account.cpu_s.values()):7.1f}{sum(account.wall_s.values()):7.1f}  {test}  ({most})")


def main() -> int:
    parser = argparse.ArgumentParser(description="Where the seconds of the tests go, by room and by kind.")
    parser.add_argument("--workers", type=int, default=1, help="how many tests at a time (tools/test: 6)")
    parser.add_argument("--show", action="store_true", help="print what was counted last")
    parser.add_argument("paths", nargs="*", metavar="PATH", help="tests, if not all")
    known_options, options = parser.parse_known_args()
    code = 0 if known_options.show else count([*known_options.paths, *options], known_options.workers)
    show()
    return code


if __name__ == "__main__":
    sys.exit(main())
