"""Lets each call of each device of a small run fail once in each way, and tells what became of it.

    python tools/fail_every_call.py [--cases N] [--seed N] [--jobs N] [--keep FILE]

Without `--cases` all of them, for hours; those that FILE holds are not done again. Prints how long after the event
lamps were dark and the arm stood, by kind of failure. Exits with 1 if anything was wrong in any case.
"""

from __future__ import annotations

import argparse
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
from nursery import Nursery  # noqa: E402

from sim.world import client  # noqa: E402


def one(k: int, kind: str) -> dict[str, Any]:
    """One case, in a folder that is removed."""
    with tempfile.TemporaryDirectory(prefix="coupole-case-") as folder:
        try:
            return run_case(Path(folder), k, kind).line()
        except Exception as error:  # noqa: BLE001  a case that cannot be judged is one that is wrong
            return {"k": k, "kind": kind, "wrong": [f"{type(error).__name__}: {error}"]}


def begin_job(parent_pid: int) -> None:
    """Have this process fork its worlds, and end soon after the one that started it, also if that is killed."""
    client._launch = Nursery().start  # type: ignore[assignment] # as the tests do

    def look() -> None:
        while os.getppid() == parent_pid:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=look, daemon=True).start()


def done(cases: list[tuple[int, str]], jobs: int) -> Iterator[dict[str, Any]]:
    """Cases as they come; each job is a process whose main thread takes the signals."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, initializer=begin_job, initargs=(os.getpid(),)) as pool:
        yield from (future.result() for future in as_completed([pool.submit(one, *case) for case in cases]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--cases", type=int, help="so many, drawn at random")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--jobs", type=int, default=2, help="cases at a time")
    parser.add_argument("--keep", type=Path, default=ROOT / "runs" / "proofs" / "calls.jsonl", help="cases done")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="coupole-case-") as folder:
        calls = count_calls(Path(folder))
    wanted = [(k, kind) for k in range(1, len(calls) + 1) for kind in KINDS]
    random.Random(options.seed).shuffle(wanted)
    wanted = wanted[: options.cases]
    options.keep.parent.mkdir(parents=True, exist_ok=True)
    kept = [json.loads(line) for line in options.keep.read_text().splitlines()] if options.keep.exists() else []
    known = {(line["k"], line["kind"]) for line in kept}
    left = [case for case in wanted if case not in known]
    with options.keep.open("a") as file:
        for line in track(done(left, options.jobs), "cases", len(left), console=Console(stderr=True)):
            kept.append(line)
            file.write(json.dumps(line) + "\n")
            file.flush()
    return report([line for line in kept if (line["k"], line["kind"]) in set(wanted)])


def report(lines: list[dict[str, Any]]) -> int:
    console = Console(soft_wrap=True)
    table = Table(
        "failure",
        "cases",
        "wrong",
        *(f"{what} after, s (median, most)" for what in ("dark", "stop", "still")),
        box=None,
    )
    for kind in KINDS:
        mine = [line for line in lines if line["kind"] == kind]
        wrong = sum(bool(line["wrong"]) for line in mine)
        table.add_row(
            kind, str(len(mine)), str(wrong), *(_spread(mine, name) for name in ("dark_s", "stop_s", "still_s"))
        )
    console.print(table)
    bad = [line for line in lines if line["wrong"]]
    for line in bad:
        console.print(
            f"call {line['k']} ({line.get('call')}), {line['kind']}: {'; '.join(line['wrong'])}", markup=False
        )
    return int(bool(bad))


def _spread(lines: list[dict[str, Any]], name: str) -> str:
    values = sorted(line[name] for line in lines if line.get(name) is not None)
    return f"{values[len(values) // 2]:.3f}, {values[-1]:.3f} (of {len(values)})" if values else "-"


if __name__ == "__main__":
    sys.exit(main())
