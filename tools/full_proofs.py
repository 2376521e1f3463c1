"""Runs the long proofs one after the other, in parts over several days: `tools/test --full`.

    python tools/full_proofs.py [--only NAME ...] [--again] [--list | --table]

Each proof is a command that can be run by itself. The result of a proof that ended well is stored in
`runs/proofs/ended.jsonl`, and the proof is not run again without `--again`. After Ctrl-C, the same command
continues. At the end, and with `--table`, all stored results are printed as in docs/reference/proofs.md. Exits
with 1 if a proof of this run failed; its output is in `runs/proofs/<name>.log`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

ROOT = Path(__file__).resolve().parent.parent
LOGS = ROOT / "runs" / "proofs"
ENDED = LOGS / "ended.jsonl"
_PYTEST = "-m pytest --full -q -n 2 --dist loadscope --timeout 3600"
_APART = {"tests/faults": "tests/faults/test_injection.py", "tests/runs": "tests/runs/test_soak.py"}
"""Test files that are separate proofs, by folder."""


@dataclass(frozen=True)
class Proof:
    """A command, and the claim that it proves."""

    name: str
    shows: str
    command: str
    """Arguments of Python."""


def _rooms() -> list[Proof]:
    """All tests at full scale, one folder for each proof."""
    folders = sorted(path.name for path in (ROOT / "tests").iterdir() if any(path.rglob("test_*.py")))
    proofs = []
    for folder in folders:
        apart = f" --ignore {_APART[f'tests/{folder}']}" if f"tests/{folder}" in _APART else ""
        command = f"{_PYTEST} tests/{folder}{apart}"
        proofs.append(Proof(f"tests-{folder}", f"tests/{folder} at full scale", command))
    return proofs


PROOFS = (
    Proof("injection", "random faults: labels true, runs completed", f"{_PYTEST} tests/faults/test_injection.py"),
    Proof("soak", "sixty runs in one world: nothing grows", f"{_PYTEST} tests/runs/test_soak.py"),
    Proof("rehearsals", "a million rehearsed shots with faults: labels true, nothing lost", "tools/soak.py"),
    Proof(
        "day", "24 h of the rig in one session: labels true, nothing grows", "tools/day.py --hours 24 --speed 20"
    ),
    Proof(
        "calls",
        "each call of each device fails or stops once in each way: the cell is safe",
        "tools/fail_every_call.py",
    ),
    Proof(
        "pairs",
        "today's failure at each call, then another one: the cell is safe",
        "tools/fail_every_call.py --pairs 600 --first drawn --keep runs/proofs/pairs.jsonl",
    ),
    Proof("freezes", "frozen at 200 random moments: arm at rest, lamps dark", "tools/freeze_at_random.py"),
    Proof("mutants", "95 % of single mistakes in critical code are noticed", "tools/mutants.py"),
    Proof("cells", "intervals of 100 random cells hold", "tools/prove_calibrations.py --cells 100"),
    Proof("cells-absolute", "the same with the arm's absolute errors", "tools/prove_calibrations.py --absolute"),
    Proof(
        "led-positions",
        "intervals of LED positions hold with causes that a plain adjustment lacks",
        "tools/prove_led_positions.py",
    ),
    Proof(
        "flat-field",
        "intervals of the flat field hold with causes that a plain fit lacks",
        "tools/prove_flat_field.py",
    ),
    Proof(
        "led-power",
        "intervals of LED power hold with causes that a plain calibration lacks",
        "tools/prove_led_power.py",
    ),
    Proof(
        "artefacts",
        "E_n of independent boards and tiles holds as stated; wrong ones are found",
        "tools/prove_artefacts.py",
    ),
    Proof(
        "chart-pictures",
        "colour profiles from pictures of drawn charts: intervals and the bound for new colours hold",
        "tools/prove_chart_pictures.py",
    ),
    Proof("corners", "corners of drawn boards: bias beside peers, u that holds", "tools/prove_corners.py"),
    Proof(
        "reflectance",
        "45 cells of materials that the fit does not know: intervals, normals, fits, new views",
        "tools/prove_reflectance.py",
    ),
    Proof("texels", "texels of pixels and of sizes: kd, normals, left-out LEDs, memory", "tools/prove_texels.py"),
    Proof("paper-table", "intervals with the paper's uncertainties hold the truth", "tools/prove_paper_table.py"),
    Proof("clusters", "1,000 materials for an object that varies everywhere", "tools/prove_clusters.py"),
    Proof("clusters-400k", "the same for 400,000 triangles", "tools/prove_clusters.py --triangles 400000"),
    Proof(
        "registration",
        "167 scans of a tower, 54 million rays: found as they are, with true uncertainties",
        "tools/prove_registration.py",
    ),
    Proof(
        "auto-exposure",
        "gilding beside lacquer: as asked, in 1.15 of the best bracket's time",
        "tools/prove_auto_exposure.py",
    ),
    Proof(
        "adaptive-lights",
        "LEDs chosen in the run, beside spread and random ones, on seven rendered objects",
        "tools/prove_adaptive_lights.py",
    ),
    Proof(
        "adaptive-views",
        "views chosen in the run, beside spread and random ones, on two objects of three materials",
        "tools/prove_adaptive_views.py",
    ),
    Proof(
        "watching",
        "50 faults in a measurement found within the view and named, 200 clean views without alarm",
        "tools/prove_watching.py",
    ),
    Proof("exports", "pixels lit anew from each export are the result's", "tools/prove_exports.py"),
    Proof(
        "blender",
        "exports look in Blender as relight shows them (`--install` makes its environment first)",
        "tools/prove_in_blender.py",
    ),
    Proof("brackets", "intervals of merged photographs hold for random cameras", "tools/prove_brackets.py"),
    Proof(
        "finishes",
        "peaks of finishes measured from spheres, by Mitsuba and by formulas",
        "tools/prove_finishes.py",
    ),
    Proof("materials", "no material creates light; drawn ways are those evaluated", "tools/prove_materials.py"),
    Proof("layers", "intervals of K and S hold, by matrix exponentials and photons", "tools/prove_layers.py"),
    Proof("paths", "500 random plans touch nothing, by python-fcl", "tools/replay_plans.py --plans 500 --seed 1"),
    *_rooms(),
)


@dataclass(frozen=True)
class Ended:
    """The result of a proof."""

    name: str
    date: str
    commit: str
    """Commit; begins with `changed: ` if files differed from it."""
    machine: str
    minutes: float
    code: int
    figure: str
    """Last line of the proof's output."""


# -- running --------------------------------------------------------------------------------------------------


def run(proof: Proof) -> Ended:
    """Run one proof with its output in a file."""
    log = LOGS / f"{proof.name}.log"
    commit, started = _commit(), time.monotonic()
    with log.open("w") as file:
        command = [sys.executable, *shlex.split(proof.command)]
        code = subprocess.run(command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, check=False).returncode
    lines = log.read_text(errors="replace").strip().splitlines()
    return Ended(
        name=proof.name,
        date=f"{datetime.now(UTC):%Y-%m-%d}",
        commit=commit,
        machine=f"{os.cpu_count()} cores",
        minutes=round((time.monotonic() - started) / 60.0, 1),
        code=code,
        figure=lines[-1].strip("= ") if lines else "",
    )


def _commit() -> str:
    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()

    changed = "changed: " if git("status", "--porcelain", "--untracked-files=no") else ""
    return changed + git("rev-parse", "--short=8", "HEAD")


# -- what is kept ---------------------------------------------------------------------------------------------


def last_ends() -> dict[str, Ended]:
    """Return the last result of each proof."""
    lines = ENDED.read_text(encoding="utf-8").splitlines() if ENDED.exists() else []
    ends = [Ended(**json.loads(line)) for line in lines]
    return {ended.name: ended for ended in ends}


def keep(proof_end: Ended) -> None:
    with ENDED.open("a", encoding="utf-8") as file:
        file.write(json.dumps(asdict(proof_end)) + "\n")


def table(ends: dict[str, Ended]) -> str:
    """Return a table in Markdown of all proofs, including those that were not run."""
    lines = [
        "| proof | shows | date, commit | machine | minutes | ended | last line |",
        "|---|---|---|---|---|---|---|",
    ]
    for proof in PROOFS:
        ended = ends.get(proof.name)
        if ended is None:
            lines.append(f"| {proof.name} | {proof.shows} | not run | | | | |")
            continue
        verdict = "good" if ended.code == 0 else f"**exit {ended.code}**"
        figure = re.sub(r"\s+", " ", ended.figure).replace("|", "/")
        lines.append(
            f"| {proof.name} | {proof.shows} | {ended.date}, {ended.commit} | {ended.machine} "
            f"| {ended.minutes:.1f} | {verdict} | {figure} |"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--only", nargs="+", choices=[proof.name for proof in PROOFS], help="only these proofs")
    parser.add_argument("--again", action="store_true", help="run what has ended well before, too")
    parser.add_argument("--list", action="store_true", help="list the proofs and their commands, run nothing")
    parser.add_argument("--table", action="store_true", help="print what is kept, run nothing")
    options = parser.parse_args()
    console = Console(soft_wrap=True)
    if options.list:
        for proof in PROOFS:
            console.print(f"{proof.name:18} {proof.shows}\n{'':18} python {proof.command}", highlight=False)
        return 0
    LOGS.mkdir(parents=True, exist_ok=True)
    failed = False
    if not options.table:
        good = set() if options.again else {name for name, ended in last_ends().items() if ended.code == 0}
        for proof in PROOFS:
            if proof.name in good or (options.only and proof.name not in options.only):
                continue
            with console.status(f"{proof.name}: {proof.shows}"):
                ended = run(proof)
            keep(ended)
            failed |= ended.code != 0
            console.print(
                f"{proof.name}: {ended.minutes:.1f} min, exit {ended.code}, {ended.figure}", markup=False
            )
    print(table(last_ends()))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
