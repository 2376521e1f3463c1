"""Mutants: single mistakes in critical code. The tests that cover the code must notice each of them.

`python tools/mutants.py` applies each mutant of `tools/mutants/*.toml` in a scratch copy of the working tree and
runs its tests there. It prints which mutants were killed (a test failed) and which survived. Verdicts are stored
in `.mutants/verdicts.jsonl`, and used again while mutant, code and tests are the same. So a run can be
interrupted.

A table names a `path` and the `tests` of that file (arguments of pytest, with `select` for its `-k`). For each
mutant it has a `name`, the `old` text (once in the file), the `new` text, and the `harm` to a user. A mutant with
`equivalent` behaves like the original for the reason given: it is listed and not run.

The exit code is 1 if fewer than 95 % of the mutants are killed; 2 if a mutant no longer fits the code, or if tests
fail without a mutant.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LEAST_KILLED = 0.95
TIMEOUT_S = 240.0
"""A mutant that hangs its tests is killed, too."""
KILLED, SURVIVED, EQUIVALENT = "killed", "survived", "equivalent"
_PASSED, _FAILED, _INTERRUPTED = 0, 1, 2
"""Exit codes of pytest; 2 also means that a test module cannot be imported."""


@dataclass(frozen=True)
class Mutant:
    """One mistake."""

    name: str
    path: str
    """Path of the file, from the root of the tree."""
    old: str
    new: str
    harm: str
    tests: tuple[str, ...]
    select: str = ""
    """Pytest's `-k`."""
    equivalent: str = ""
    """Reason why no test can notice the mutant; empty if a test can."""


@dataclass(frozen=True)
class Verdict:
    """Outcome of a mutant."""

    name: str
    outcome: str
    seconds: float
    key: str
    """Key that changes with the mutant, its file and its tests."""
    noticed_by: str = ""
    """The first test that failed."""


class Stale(Exception):
    """A mutant does not fit the code, or its tests fail without the mutant."""


def read_mutants(folder: Path) -> list[Mutant]:
    """All mutants of a folder's tables, in the order of the files' names. Raises Stale if a name comes twice."""
    mutants: list[Mutant] = []
    for table in sorted(folder.glob("*.toml")):
        for file in tomllib.loads(table.read_text(encoding="utf-8"))["file"]:
            for entry in file["mutant"]:
                settings = {"tests": file["tests"], "select": file.get("select", ""), **entry}
                settings["tests"] = tuple(settings["tests"])
                mutants.append(Mutant(path=file["path"], **settings))
    names = [mutant.name for mutant in mutants]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise Stale(f"these names come twice: {', '.join(twice)}")
    return mutants


def mutated_text(mutant: Mutant, root: Path) -> str:
    """Return the text of the mutant's file with the mistake. Raises Stale."""
    text = (root / mutant.path).read_text(encoding="utf-8")
    count = text.count(mutant.old)
    if count != 1 or mutant.old == mutant.new:
        raise Stale(f"{mutant.name}: `{mutant.old}` is {count} times in {mutant.path}, must be there once")
    return text.replace(mutant.old, mutant.new)


def stale(mutants: Iterable[Mutant], root: Path) -> list[str]:
    """Return the mutants and tests that do not fit the tree: mutants whose text is missing, tests that do not
    exist."""
    faults = []
    for mutant in mutants:
        try:
            mutated_text(mutant, root)
        except (Stale, OSError) as error:
            faults.append(str(error))
        missing = [test for test in mutant.tests if not (root / test.split("::")[0]).exists()]
        faults += [f"{mutant.name}: there is no {test}" for test in missing]
    return faults


class Bench:
    """A scratch copy of the tree, in which one mutant at a time is tested."""

    def __init__(self, root: Path, scratch: Path) -> None:
        self._root, self._scratch = root, scratch
        self._healthy: set[tuple[tuple[str, ...], str]] = set()
        listing = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=root,
            check=True,
            capture_output=True,
        ).stdout
        for name in filter(None, listing.decode().split("\0")):
            if (root / name).is_file():
                (scratch / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(root / name, scratch / name)

    def key(self, mutant: Mutant) -> str:
        """Digest of mutant, code and tests."""
        digest = hashlib.sha256(repr(mutant).encode())
        digest.update((self._root / mutant.path).read_bytes())
        for test in mutant.tests:
            place = self._root / test.split("::")[0]
            for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
                digest.update(file.read_bytes())
        return digest.hexdigest()[:16]

    def judge(self, mutant: Mutant) -> Verdict:
        """Test a mutant. Raises Stale."""
        key = self.key(mutant)
        if mutant.equivalent:
            return Verdict(mutant.name, EQUIVALENT, 0.0, key, mutant.equivalent)
        text = mutated_text(mutant, self._root)
        self._see_healthy(mutant)
        file = self._scratch / mutant.path
        started_s = time.monotonic()
        try:
            file.write_text(text, encoding="utf-8")
            code, failing_test = self._run(mutant)
        finally:
            shutil.copyfile(self._root / mutant.path, file)
        if code not in (_PASSED, _FAILED, _INTERRUPTED):
            raise Stale(f"{mutant.name}: pytest ended with {code} for {' '.join(mutant.tests)}")
        outcome = SURVIVED if code == _PASSED else KILLED
        return Verdict(mutant.name, outcome, round(time.monotonic() - started_s, 1), key, failing_test)

    def _see_healthy(self, mutant: Mutant) -> None:
        """Check that the mutant's tests pass without it; otherwise a failure would prove nothing."""
        tests = (mutant.tests, mutant.select)
        if tests in self._healthy:
            return
        code, failing_test = self._run(mutant)
        if code != _PASSED:
            raise Stale(
                f"{mutant.name}: {' '.join(mutant.tests)} fail without any mutant (code {code}): {failing_test}"
            )
        self._healthy.add(tests)

    def _run(self, mutant: Mutant) -> tuple[int, str]:
        """Return the exit code of pytest, and the first test that failed."""
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--no-header"]
        command += ["-k", mutant.select] if mutant.select else []
        # what a mutant does not change is compiled once for all of them (coupole/kernels/kept_code.py)
        env = {**os.environ, "NUMBA_CACHE_DIR": str(self._scratch / ".numba"), "PYTHONDONTWRITEBYTECODE": "1"}
        env["PYTHONPATH"] = str(self._scratch)  # also for the scripts that tests begin
        try:
            process = subprocess.run(
                [*command, *mutant.tests],
                cwd=self._scratch,
                env=env,
                capture_output=True,
                text=True,
                timeout=TIMEOUT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return _FAILED, f"no end within {TIMEOUT_S:g} s"
        lines = [line for line in process.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
        return process.returncode, lines[0].split(" ", 1)[1].split(" - ")[0] if lines else ""


def earlier(path: Path) -> dict[str, Verdict]:
    """Return verdicts of earlier runs by key; an incomplete last line is left out."""
    verdict_of_key = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            verdict = Verdict(**json.loads(line))
        except (json.JSONDecodeError, TypeError):
            continue
        verdict_of_key[verdict.key] = verdict
    return verdict_of_key


def judge_all(
    mutants: Sequence[Mutant], root: Path, results: Path, *, again: bool
) -> tuple[list[Verdict], list[str]]:
    """Return verdicts on all mutants, and the mutants that could not be judged."""
    results.parent.mkdir(parents=True, exist_ok=True)
    earlier_verdicts = {} if again else earlier(results)
    verdicts, troubles = [], []
    with tempfile.TemporaryDirectory(prefix="mutants-") as scratch, results.open("a", encoding="utf-8") as file:
        bench = Bench(root, Path(scratch))
        for number, mutant in enumerate(mutants, 1):
            verdict = earlier_verdicts.get(bench.key(mutant))
            if verdict is None:
                try:
                    verdict = bench.judge(mutant)
                except Stale as error:
                    troubles.append(str(error))
                    print(f"{number}/{len(mutants)} {error}", flush=True)
                    continue
                file.write(json.dumps(asdict(verdict)) + "\n")
                file.flush()
            verdicts.append(verdict)
            print(f"{number}/{len(mutants)} {verdict.outcome:10} {verdict.name}", flush=True)
    return verdicts, troubles


def table(verdicts: Sequence[Verdict], mutants: Sequence[Mutant]) -> str:
    """One line for each mutant, then the figures."""
    by_name = {mutant.name: mutant for mutant in mutants}
    lines = ["", "| mutant | file | outcome | noticed by |", "|---|---|---|---|"]
    for verdict in verdicts:
        path = by_name[verdict.name].path
        lines.append(f"| {verdict.name} | {path} | {verdict.outcome} | {verdict.noticed_by} |")
    viable = [verdict for verdict in verdicts if verdict.outcome != EQUIVALENT]
    lines += [
        "",
        f"{sum(v.outcome == KILLED for v in viable)} of {len(viable)} killed ({_share(viable):.1%}), ",
    ]
    lines[-1] += f"{len(verdicts) - len(viable)} equivalent, {sum(v.seconds for v in viable):.0f} s"
    return "\n".join(lines)


def _share(verdicts: Sequence[Verdict]) -> float:
    return sum(verdict.outcome == KILLED for verdict in verdicts) / len(verdicts) if verdicts else 1.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help="mutants with this in their name")
    parser.add_argument("--again", action="store_true", help="use no verdict of an earlier run")
    parser.add_argument("--check", action="store_true", help="run nothing: do all mutants still fit the code?")
    parser.add_argument("--results", type=Path, default=ROOT / ".mutants" / "verdicts.jsonl")
    options = parser.parse_args()
    mutants = read_mutants(ROOT / "tools" / "mutants")
    mutants = [
        mutant for mutant in mutants if not options.only or any(part in mutant.name for part in options.only)
    ]
    if options.check:
        faults = stale(mutants, ROOT)
        print("\n".join(faults) or f"{len(mutants)} mutants fit the code")
        return 2 if faults else 0
    verdicts, troubles = judge_all(mutants, ROOT, options.results, again=options.again)
    print(table(verdicts, mutants))
    print("\n".join(troubles))
    viable = [verdict for verdict in verdicts if verdict.outcome != EQUIVALENT]
    return 2 if troubles else int(_share(viable) < LEAST_KILLED)


if __name__ == "__main__":
    sys.exit(main())
