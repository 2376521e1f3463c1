"""Rehearses a plan again and again in one process, with random faults, and checks each label against the truth.

    python tools/soak.py [--shots N] [--faults-per-shot P] [--seed N] [--speed N] [--keep FILE]

Rehearsals in FILE are not done again, so a soak can be done in parts; an interrupted part loses the rehearsal that
was running. Prints the events, with memory and open files of controller and world. It also lists sessions that
ended without a fault that ends a session (on a busy machine, the controller may fall behind the world). Exits with
1 if a label was false, if a shot was proven twice or lost without notice, or if memory or open files have grown.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "runs")]

from soaking import growths, soak  # noqa: E402

from smallest import add_smallest  # noqa: E402

GROWTH_BYTES, GROWTH_FILES = 50e6, 10
"""Growth that a process may have over the whole soak, after its warm-up."""
WRONG = ("mislabelled", "twice", "lost")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--shots", type=int, default=1_000_000, help="at least so many")
    parser.add_argument("--faults-per-shot", type=float, default=1e-3, help="how often something goes wrong")
    parser.add_argument("--seed", type=int, default=0, help="of the faults")
    parser.add_argument("--speed", type=float, default=20.0, help="pace while the controller waits")
    parser.add_argument("--keep", type=Path, default=ROOT / "runs" / "proofs" / "soak.jsonl", help="what was done")
    add_smallest(parser, shots=1)
    options = parser.parse_args()
    options.keep.parent.mkdir(parents=True, exist_ok=True)
    lines = [json.loads(line) for line in options.keep.read_text().splitlines()] if options.keep.exists() else []
    shot_count = sum(line["shots"] for line in lines)
    settings = {"seed": options.seed, "faults_per_shot": options.faults_per_shot, "speed": options.speed}
    if any(line["settings"] != settings for line in lines):
        parser.error(f"{options.keep} holds rehearsals with other settings than {settings}: name another file")
    if shot_count < options.shots:
        with (
            tempfile.TemporaryDirectory(prefix="coupole-soak-") as folder,
            soak(Path(folder), **settings) as soaking,
            options.keep.open("a") as file,
            Progress(console=Console(stderr=True)) as bar,
        ):
            task = bar.add_task("shots", total=options.shots, completed=shot_count)
            while shot_count < options.shots:
                lines.append({**soaking.rehearse(len(lines)).line(), "settings": settings})
                file.write(json.dumps(lines[-1]) + "\n")
                file.flush()
                shot_count += lines[-1]["shots"]
                bar.update(task, completed=shot_count)
    return report(lines)


def report(lines: list[dict[str, Any]]) -> int:
    """Print the whole report; return 1 if anything was wrong."""
    console = Console(soft_wrap=True, highlight=False)
    table = Table(box=None, show_header=False)
    for name in ("shots", "frames", "proven", "sessions", "reshot"):
        table.add_row(name, str(sum(line[name] for line in lines)))
    table.add_row("faults", _count_text(lines, "faults"))
    table.add_row("sessions ended early", _count_text(lines, "ended_by"))
    for name in ("told_missing", "unexplained", *WRONG):
        table.add_row(name.replace("_", " "), str(sum(len(line[name]) for line in lines)))
    any_growth = False
    for process in ("controller", "world"):
        for growth in growths([line[process] for line in lines], lines[0]["shots"]):
            table.add_row(f"{process} {growth.pid}", str(growth))
            any_growth |= growth.bytes > GROWTH_BYTES or growth.files > GROWTH_FILES
    console.print(table)
    wrong = [f"{name}: {text}" for line in lines for name in ("unexplained", *WRONG) for text in line[name]]
    for text in wrong:
        console.print(text, markup=False)
    return int(any_growth or any(line[name] for line in lines for name in WRONG))


def _count_text(lines: list[dict[str, Any]], name: str) -> str:
    total: Counter[str] = Counter()
    for line in lines:
        total.update(line[name])
    return f"{total.total()}: " + ", ".join(f"{count} {kind}" for kind, count in total.most_common())


if __name__ == "__main__":
    sys.exit(main())
