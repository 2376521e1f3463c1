"""Runs the long proofs one after the other and prints a table of results: `tools/test --full`.

    python tools/full_proofs.py [--only NAME ...] [--list]

Each proof is a command that can be run by itself. Exits with 1 if one of them failed; its output is in
`runs/proofs/<name>.log`.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
LOGS = ROOT / "runs" / "proofs"
_PYTEST = "-m pytest --full -q -n 2 --dist loadscope --timeout 3600"


@dataclass(frozen=True)
class Proof:
    """A command and what it proves."""

    name: str
    shows: str
    command: str
    """Arguments for Python."""


PROOFS = (
    Proof("injection", "random faults: labels true, runs completed", f"{_PYTEST} tests/faults/test_injection.py"),
    Proof("soak", "sixty runs in one world: nothing grows", f"{_PYTEST} tests/runs/test_soak.py"),
    Proof("rehearsals", "a million rehearsed shots with faults: labels true, nothing lost", "tools/soak.py"),
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
    Proof("fuzz", "10,000 mutated files and messages are read or refused", f"{_PYTEST} tests/fuzz"),
    Proof("mutants", "95 % of single mistakes in critical code are noticed", "tools/mutants.py"),
    Proof("cells", "intervals of 100 random cells hold", "tools/prove_calibrations.py --cells 100"),
    Proof("cells-absolute", "the same with the arm's absolute errors", "tools/prove_calibrations.py --absolute"),
    Proof(
        "reflectance",
        "45 cells of materials that the fit does not know: intervals, normals, fits, new views",
        "tools/prove_reflectance.py",
    ),
    Proof("paper-table", "intervals with the paper's uncertainties hold the truth", "tools/prove_paper_table.py"),
    Proof("clusters", "1,000 materials for an object that varies everywhere", "tools/prove_clusters.py"),
    Proof("clusters-400k", "the same for 400,000 triangles", "tools/prove_clusters.py --triangles 400000"),
    Proof(
        "registration",
        "167 scans of a tower, 54 million rays: found as they are, with true uncertainties",
        "tools/prove_registration.py",
    ),
    Proof("exports", "pixels lit anew from each export are the result's", "tools/prove_exports.py"),
    Proof("layers", "intervals of K and S hold, by matrix exponentials and photons", "tools/prove_layers.py"),
    Proof("paths", "500 random plans touch nothing, by python-fcl", "tools/replay_plans.py --plans 500 --seed 1"),
    Proof("conformance", "every driver against its contract", f"{_PYTEST} tests/conformance"),
    Proof(
        "tests",
        "all other tests at full scale",
        f"{_PYTEST} tests --ignore tests/conformance --ignore tests/faults/test_injection.py "
        "--ignore tests/runs/test_soak.py --ignore tests/fuzz",
    ),
)


@dataclass(frozen=True)
class Ended:
    """The result of a proof."""

    proof: Proof
    minutes: float
    code: int
    last_line: str


def run(proof: Proof) -> Ended:
    """Run one proof with its output in a file."""
    LOGS.mkdir(parents=True, exist_ok=True)
    log = LOGS / f"{proof.name}.log"
    started = time.monotonic()
    with log.open("w") as file:
        command = [sys.executable, *shlex.split(proof.command)]
        code = subprocess.run(command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, check=False).returncode
    lines = log.read_text(errors="replace").strip().splitlines()
    return Ended(proof, (time.monotonic() - started) / 60.0, code, lines[-1].strip("= ") if lines else "")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--only", nargs="+", choices=[proof.name for proof in PROOFS], help="only these proofs")
    parser.add_argument("--list", action="store_true", help="list the proofs and their commands, run nothing")
    options = parser.parse_args()
    console = Console(soft_wrap=True)
    if options.list:
        for proof in PROOFS:
            console.print(f"{proof.name:15} {proof.shows}\n{'':15} python {proof.command}", highlight=False)
        return 0
    chosen = [proof for proof in PROOFS if not options.only or proof.name in options.only]
    ended = []
    for proof in chosen:
        with console.status(f"{proof.name}: {proof.shows}"):
            ended.append(run(proof))
    table = Table("proof", "shows", "minutes", "ended", "last line", box=None)
    for one in ended:
        verdict = "[green]good[/]" if one.code == 0 else f"[red]exit {one.code}[/]"
        table.add_row(one.proof.name, one.proof.shows, f"{one.minutes:.1f}", verdict, one.last_line)
    console.print(table)
    return int(any(one.code for one in ended))


if __name__ == "__main__":
    sys.exit(main())
