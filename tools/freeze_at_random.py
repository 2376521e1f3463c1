"""Freezes the processes of small runs (SIGSTOP) at random moments, and reports how arm and lamps behaved.

    python tools/freeze_at_random.py [--freezes N] [--arm rsi|eki|ur ...] [--jobs N] [--seed N] [--keep FILE]

N freezes are made in each arm's runs, in real time; a run takes about twenty seconds. Freezes in FILE are not done
again. About half of the freezes are of the command's process, several in a run. The others are of the process that
answers the arm (RSI, UR); such a freeze ends the run. One in four is in a burst, the rest are in a motion. Exits
with 1 if a promise of docs/reference/safety.md was broken.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import random
import sys
import tempfile
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "faults"), str(ROOT / "tools")]

import cells  # noqa: E402
import freezing  # noqa: E402
from freezing import ARMS, FROZEN, Freeze  # noqa: E402

from fail_every_call import begin_job  # noqa: E402


def one_run(arm: str, number: int, seed: int) -> list[dict[str, Any]]:
    """Return the freezes of one run. `wrong` of the last one also contains the faults of the whole run."""
    draw, records = random.Random(f"{seed} {arm} {number}"), []
    process_name = FROZEN[int(number % 8 != 0 and arm != "eki")]
    with tempfile.TemporaryDirectory(prefix="coupole-freeze-") as folder:
        cell = freezing.cell_in(Path(folder), arm)
        with freezing.running(cell, arm) as (world, process):
            moving = draw.random() < 0.75
            while freezing.moment(world, process, draw, moving=moving):
                observation = freezing.freeze(
                    world, freezing.frozen_pid(process, process_name), Freeze(arm, process_name, moving)
                )
                records.append({"number": number, **observation.line()})
                if process_name != FROZEN[0] or not freezing.go_on(cell.run_folder, process):
                    break
                moving = draw.random() < 0.75
            outcome = cells.finish(process)
            state = world.ask("state")
        if records:
            records[-1]["wrong"] += _wrong_at_the_end(outcome, process_name, state, cell.run_folder)
    return records


def _wrong_at_the_end(process_end: cells.Ended, freeze_kind: str, state: dict[str, Any], run: Path) -> list[str]:
    wrong = []
    if process_end.code != (0 if freeze_kind == FROZEN[0] else 4):
        wrong.append(f"exit code {process_end.code}: {process_end.err[-500:]}")
    if state["arm_moving"] or state["shining"] or state["panels"]:
        wrong.append("the cell is not safe at the end")
    if process_end.code == 0:
        try:
            cells.assert_each_shot_proven_once(run)
        except AssertionError as error:
            wrong.append(f"frames: {error}")
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--freezes", type=int, default=70, help="of each arm")
    parser.add_argument("--arm", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--keep", type=Path, default=ROOT / "runs" / "proofs" / "freezes.jsonl", help="freezes done"
    )
    options = parser.parse_args()
    options.keep.parent.mkdir(parents=True, exist_ok=True)
    lines = freezing.lines_in(options.keep)
    console = Console(stderr=True)
    with Progress(console=console) as progress:
        bars = {arm: progress.add_task(arm, total=options.freezes) for arm in options.arm}

        def keep(future: Future[list[dict[str, Any]]], file: TextIO) -> None:
            lines.extend(new_lines := future.result())
            file.writelines(json.dumps(line) + "\n" for line in new_lines)
            file.flush()
            for arm, bar in bars.items():
                progress.update(bar, completed=_count(lines, arm))

        context = multiprocessing.get_context("spawn")
        with (
            options.keep.open("a") as file,
            ProcessPoolExecutor(options.jobs, context, initializer=begin_job, initargs=(os.getpid(),)) as pool,
        ):
            for arm in options.arm:
                numbers = itertools.count(
                    1 + max((record["number"] for record in lines if record["arm"] == arm), default=-1)
                )
                under_way: set[Future[list[dict[str, Any]]]] = set()
                while (remaining := options.freezes - _count(lines, arm)) > 0 or under_way:
                    while remaining > 0 and len(under_way) < options.jobs:
                        under_way.add(pool.submit(one_run, arm, next(numbers), options.seed))
                    finished_futures, under_way = wait(under_way, return_when=FIRST_COMPLETED)
                    for future in finished_futures:
                        keep(future, file)
    return report([line for line in lines if line["arm"] in options.arm])


def _count(lines: list[dict[str, Any]], arm: str) -> int:
    return sum(line["arm"] == arm for line in lines)


def report(lines: list[dict[str, Any]]) -> int:
    table = Table(
        "arm", "frozen", "in", "cases", "wrong", *(f"{event}, s" for event in ("brakes", "still", "dark"))
    )
    table.add_column("turned, deg")
    for arm in ARMS:
        for process_name in FROZEN:
            for moving in (True, False):
                cases = [
                    record
                    for record in lines
                    if (record["arm"], record["frozen"], record["while_moving"]) == (arm, process_name, moving)
                ]
                if cases:
                    wrong = sum(bool(record["wrong"]) for record in cases)
                    spreads = (
                        _median_and_most(cases, name) for name in ("brakes_s", "still_s", "dark_s", "turned_deg")
                    )
                    table.add_row(
                        arm, process_name, "motion" if moving else "burst", str(len(cases)), str(wrong), *spreads
                    )
    Console(soft_wrap=True).print(table)
    bad = [line for line in lines if line["wrong"]]
    for line in bad:
        print(f"{line['arm']}, run {line['number']}, {line['frozen']}: {'; '.join(line['wrong'])}")
    return int(bool(bad))


def _median_and_most(lines: list[dict[str, Any]], name: str) -> str:
    values = sorted(line[name] for line in lines if line[name] is not None)
    return f"{values[len(values) // 2]:.3f}, {values[-1]:.3f}" if values else "-"


if __name__ == "__main__":
    sys.exit(main())
