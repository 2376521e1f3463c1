"""Runs a plan for a day or longer on the rig's clock, and reports growth of memory and files.

    python tools/day.py [--hours H] [--leds N] [--speed N] [--keep FILE]

This is the real command on disk, at the plan's own pace on the rig's clock. Waiting times pass faster, so a day
takes half an hour or more. Prints a table of memory, handles, threads, sockets and sizes of files after its
warm-up and at its end. Exits with 1 if a label was false, if a frame was lost, or if memory, handles, threads or
sockets grew. FILE gets the samples.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "runs")]

from long_day import WORLD, Day, Watcher, cell_in, wrong_at_the_end  # noqa: E402

WARM_UP_SHARE = 0.1
GROWTH_BYTES, GROWTH_OTHER = 50e6, 3
"""Growth that a process may have after the warm-up. It may have a few handles, threads and sockets more or less,
because samples are taken at any moment."""
KEPT_BYTES = 400
"""Additional bytes that the controller may store for each frame: which shots are proven, and where."""
WRAP_S = 2**32 / 1e6
MOST_SESSIONS = 20
WHO = ("controller", "arm's process", "world")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--hours", type=float, default=24.0, help="of the rig's clock")
    parser.add_argument("--leds", type=int, default=1080, help="of each view")
    parser.add_argument("--speed", type=float, default=100.0, help="pace while the command waits")
    parser.add_argument("--keep", type=Path, default=ROOT / "runs" / "proofs" / "day.jsonl", help="the samples")
    options = parser.parse_args()
    options.keep.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="coupole-day-", dir=options.keep.parent) as folder:
        cell = cell_in(Path(folder), options.hours, options.leds, options.speed)
        with cell.world(**WORLD) as world:
            day = _follow_day(Watcher(cell, world, seed=0), options.hours)
        wrong = wrong_at_the_end(cell, day)
    options.keep.write_text("".join(json.dumps(sample) + "\n" for sample in day.samples))
    return report(day, wrong)


def _follow_day(watcher: Watcher, hours: float) -> Day:
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("hours of the rig", total=hours)
        for _ in watcher.follow(MOST_SESSIONS):
            bar.update(task, completed=watcher.day.hours)
    return watcher.day


def report(day: Day, wrong: list[str]) -> int:
    """Print the growth; return 1 if anything was wrong."""
    console = Console(soft_wrap=True, highlight=False)
    console.print(
        f"{day.hours:.2f} h of the rig's clock ({day.hours * 3600.0 / WRAP_S:.1f} turns of a counter of 32 bits "
        f"in us), {day.labels} labels, {day.dropped} edges dropped, {len(day.mislabelled)} mislabelled, "
        f"{1 + len(day.ends)} sessions"
    )
    for text in day.ends:
        console.print(f"ended, and resumed: {text}", markup=False)
    shots = [sample for sample in day.samples if sample["labels"] < day.labels]  # then the report is written
    warm = [sample for sample in shots if sample["labels"] >= WARM_UP_SHARE * day.labels] or day.samples
    labels = warm[-1]["labels"] - warm[0]["labels"]
    table = Table("who", "what", "after the warm-up", "at the end", "most", "grew by", box=None)
    limits = {"bytes": GROWTH_BYTES, "files": GROWTH_OTHER, "threads": GROWTH_OTHER, "sockets": GROWTH_OTHER}
    for process in WHO:
        for quantity, most in limits.items():
            values = [sample[process][quantity] for sample in warm if process in sample]
            if not values:
                continue
            first, last = _median(values[: len(values) // 10 + 1]), _median(values[-len(values) // 10 - 1 :])
            table.add_row(
                process, quantity, *(f"{value:,.0f}" for value in (first, last, max(values), last - first))
            )
            if last - first > most + (
                KEPT_BYTES * labels if (process, quantity) == ("controller", "bytes") else 0
            ):
                wrong.append(f"{process}: {quantity} grew by {last - first:,.0f}")
    for quantity in warm[0]["on disk"]:
        sizes = [sample["on disk"][quantity] for sample in (warm[0], warm[-1])]
        a_frame = (sizes[1] - sizes[0]) / max(1, labels)
        table.add_row(
            "on disk", f"{quantity}, bytes", *(f"{size:,}" for size in sizes), "", f"{a_frame:.1f} a frame"
        )
    console.print(table)
    for text in wrong:
        console.print(text, markup=False)
    return int(bool(wrong))


def _median(values: list[Any]) -> float:
    return float(sorted(values)[len(values) // 2])


if __name__ == "__main__":
    sys.exit(main())
