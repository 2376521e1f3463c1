"""Lets each call of each device of a small run fail, stop or change once in each way, and reports the
consequences.

    python tools/fail_every_call.py [--cases N] [--calls N --skip N] [--kinds WORD ...] [--seed N] [--keep FILE]
    python tools/fail_every_call.py --pairs N [--first KIND] ...

Without `--cases` all cases are tried, which takes hours. Cases in FILE are not done again, so several calls over
days can do them together, with the same seed and `--calls`; `--skip` leaves out the first cases of the draw, which
are done elsewhere. `--pairs` draws this number of cases with two failures in one session, the second after the
first; with `--first`, the first failure comes at every call in turn. Prints how long after the event the lamps
were dark and the arm stood, by kind of failure. Exits with 1 if anything was wrong in any case.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import json
import multiprocessing
import os
import random
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "faults")]

from failing_calls import KINDS, count_calls, run_case  # noqa: E402
from happenings import MEANWHILE, Event  # noqa: E402
from judged_sessions import draw_pair, drawn_kind, run_events  # noqa: E402
from nursery import NURSERY  # noqa: E402

from sim.world import client  # noqa: E402

Case = tuple[Event, ...]


_COLLECTS_EVERY = 10
"""Number of cases of a job between garbage collections."""
_number_of_case = itertools.count()


def run_one(case: Case) -> dict[str, Any]:
    """Run one case, in a folder that is removed afterwards."""
    begun_s = time.monotonic()
    if next(_number_of_case) % _COLLECTS_EVERY == 0:
        # `cells.here` freezes the objects that remain after a session, with the files and memory that they hold
        gc.unfreeze()
        gc.collect()
        gc.freeze()  # half a million objects, which each session would otherwise examine
    with tempfile.TemporaryDirectory(prefix="coupole-case-") as folder:
        try:
            if len(case) == 1 and case[0].kind in KINDS:
                line = run_case(Path(folder), case[0].k, case[0].kind).line()
            else:
                line = run_events(Path(folder), case).line()
        except Exception as error:  # noqa: BLE001  a case that cannot be judged is one that is wrong
            line = {"k": case[0].k, "kind": case[0].kind, "wrong": [f"{type(error).__name__}: {error}"]}
            line |= {"k2": case[1].k, "kind2": case[1].kind} if len(case) > 1 else {}
    return {**line, "took_s": round(time.monotonic() - begun_s, 2)}


def case_of(line: dict[str, Any]) -> Case:
    """Return the case of a line of FILE."""
    second = (Event(line["k2"], line["kind2"]),) if line.get("kind2") else ()
    return (Event(line["k"], line["kind"]), *second)


def begin_job(parent_pid: int) -> None:
    """Let this process fork its worlds, and end it soon after the process that started it, also if that is
    killed."""
    client._launch = NURSERY.start  # like the tests

    def look() -> None:
        while os.getppid() == parent_pid:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=look, daemon=True).start()


def run_all(cases: list[Case], jobs: int) -> Iterator[dict[str, Any]]:
    """Yield the results of cases as they come. Each job is a process, whose main thread gets the signals."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, initializer=begin_job, initargs=(os.getpid(),)) as pool:
        try:
            yield from (future.result() for future in as_completed([pool.submit(run_one, case) for case in cases]))
        finally:  # Ctrl-C: running cases are ended, and no further one is begun
            pool.shutdown(wait=False, cancel_futures=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--cases", type=int, help="so many, drawn at random")
    parser.add_argument("--calls", type=int, help="of a session; counted if not given (a busy machine has more)")
    parser.add_argument("--skip", type=int, default=0, metavar="N", help="leave out the first N of the draw")
    parser.add_argument("--kinds", nargs="+", default=[], metavar="WORD", help="kinds that begin with these words")
    parser.add_argument("--pairs", type=int, help="so many cases of two failures in one session")
    parser.add_argument("--first", help="the first of both, at every call in turn: a kind, or `drawn` by the day")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--jobs", type=int, default=2, help="cases at a time")
    parser.add_argument("--keep", type=Path, default=ROOT / "runs" / "proofs" / "calls.jsonl", help="cases done")
    options = parser.parse_args()
    if options.first not in (None, "drawn", *KINDS, *MEANWHILE):
        parser.error(f"--first: expected `drawn` or one of {', '.join((*KINDS, *MEANWHILE))}")
    calls = options.calls or counted_calls()
    cases = choose_cases(options, calls)[options.skip :]
    print(f"{calls} calls, {len(cases)} cases", file=sys.stderr)
    options.keep.parent.mkdir(parents=True, exist_ok=True)
    outcomes = (
        [json.loads(line) for line in options.keep.read_text().splitlines()] if options.keep.exists() else []
    )
    earlier_cases = {case_of(line) for line in outcomes}
    remaining_cases = [case for case in cases if case not in earlier_cases]
    with options.keep.open("a") as file:
        for line in track(
            run_all(remaining_cases, options.jobs), "cases", len(remaining_cases), console=Console(stderr=True)
        ):
            outcomes.append(line)
            file.write(json.dumps(line) + "\n")
            file.flush()
    selection = set(cases)
    return report([line for line in outcomes if case_of(line) in selection])


def counted_calls() -> int:
    """Count the calls of a session without failure."""
    with tempfile.TemporaryDirectory(prefix="coupole-case-") as folder:
        return len(count_calls(Path(folder)))


def choose_cases(options: argparse.Namespace, calls: int) -> list[Case]:
    """Return the requested cases, in an order that the seed determines."""
    draw = random.Random(options.seed)
    if options.pairs is not None:
        first = drawn_kind() if options.first == "drawn" else options.first
        cases: dict[Case, None] = {}
        while len(cases) < options.pairs:
            k = len(cases) % calls + 1 if first else None
            cases[draw_pair(draw, calls, first, k)] = None
        return list(cases)
    kinds = [kind for kind in (*KINDS, *MEANWHILE) if not options.kinds or kind.startswith(tuple(options.kinds))]
    single_cases: list[Case] = [(Event(k, kind),) for k in range(1, calls + 1) for kind in kinds]
    draw.shuffle(single_cases)
    return single_cases[: options.cases]


def report(lines: list[dict[str, Any]]) -> int:
    console = Console(soft_wrap=True)
    table = Table(
        "failure",
        "cases",
        "wrong",
        "reached both",
        *(f"{event} after, s (median, most)" for event in ("dark", "stop", "still")),
        "a case takes, s",
        box=None,
    )
    for kind in (*KINDS, *MEANWHILE):
        if not (lines_of_kind := [line for line in lines if kind in (line["kind"], line.get("kind2"))]):
            continue
        wrong = sum(bool(line["wrong"]) for line in lines_of_kind)
        double_faults = sum(bool(line.get("call2")) for line in lines_of_kind)
        times = [_median_and_most(lines_of_kind, name) for name in ("dark_s", "stop_s", "still_s", "took_s")]
        table.add_row(kind, str(len(lines_of_kind)), str(wrong), str(double_faults or "-"), *times)
    console.print(table)
    bad = [line for line in lines if line["wrong"]]
    console.print(f"{len(lines)} cases, {len(bad)} wrong", markup=False)
    for line in bad:
        then = f", then call {line['k2']} ({line.get('call2')}), {line['kind2']}" if line.get("kind2") else ""
        console.print(
            f"call {line['k']} ({line.get('call')}), {line['kind']}{then}: {'; '.join(line['wrong'])}",
            markup=False,
        )
    return int(bool(bad))


def _median_and_most(lines: list[dict[str, Any]], name: str) -> str:
    values = sorted(line[name] for line in lines if line.get(name) is not None)
    return f"{values[len(values) // 2]:.3f}, {values[-1]:.3f} (of {len(values)})" if values else "-"


if __name__ == "__main__":
    sys.exit(main())
