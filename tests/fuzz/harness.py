"""Runs mutated files through the program in a process of their own, with little memory and little time.

A case ends well if the file is read, or refused by an error of `coupole.errors` whose message names the file.
Anything else is a violation: another exception, a crash, more than `MEMORY_BYTES`, more than `CASE_S`.

A case is a target's name, a seed and a number, and always the same. To see one again:

    python tests/fuzz/harness.py TARGET SEED NUMBER
"""

from __future__ import annotations

import contextlib
import json
import resource
import select
import shutil
import subprocess
import sys
import tempfile
import traceback
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).resolve().parents[1])]

from fuzz.mutation import mutated, with_hostile
from fuzz.target import Target
from fuzz.targets import CONFIGS, TARGETS

MEMORY_BYTES = 4 * 1024**3
CASE_S = 20.0
_START_S = 120.0
"""For imports, and for code that is compiled for the first time."""
HOSTILE_SEED = "hostile"
"""Seeds that begin with it put one of `mutation.HOSTILE` into the file."""
_OF_NAME = {target.name: target for target in TARGETS}


def case_of(target: Target, seed: str, number: int) -> bytes:
    """The mutated file of one case. Number 0 is the first seed as it is: it must be read."""
    random = Random(f"{target.name}/{seed}/{number}")
    seeds = target.seeds()
    if seed.startswith(HOSTILE_SEED):
        return with_hostile(random.choice(seeds), random, number)
    return mutated(random.choice(seeds), random) if number else seeds[0]


@dataclass(frozen=True)
class Violation:
    """A case that ended badly."""

    target: str
    seed: str
    number: int
    what: str

    def __str__(self) -> str:
        again = f"python tests/fuzz/harness.py {self.target} {self.seed} {self.number}"
        return f"{self.target}, seed {self.seed}, case {self.number}: {self.what}\n  see it again: {again}"


class Fuzzer:
    """A worker process that takes one case after the other; it is replaced when it dies or hangs."""

    def __init__(self) -> None:
        self._worker: subprocess.Popen[str] | None = None

    def violations(self, target: Target, seed: str, numbers: range) -> list[Violation]:
        """The cases of these numbers that end badly."""
        outcomes = ((number, self._run(target.name, seed, number)) for number in numbers)
        return [Violation(target.name, seed, number, what) for number, what in outcomes if what]

    def close(self) -> None:
        if self._worker is not None:
            self._worker.kill()
            self._worker.wait()
            for stream in (self._worker.stdin, self._worker.stdout):
                if stream is not None:
                    stream.close()
        self._worker = None

    def _run(self, name: str, seed: str, number: int) -> str:
        """Empty if the case ends well."""
        worker = self._worker or self._start()
        assert worker.stdin is not None
        worker.stdin.write(json.dumps([name, seed, number]) + "\n")
        worker.stdin.flush()
        answer = self._answer(CASE_S)
        if answer is None:
            code = worker.poll()
            self.close()
            return f"more than {CASE_S:g} s" if code is None else f"the process died with {code}"
        return str(json.loads(answer))

    def _start(self) -> subprocess.Popen[str]:
        self._worker = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        if self._answer(_START_S) is None:
            self.close()
            raise RuntimeError("the fuzzer's worker does not start")
        return self._worker

    def _answer(self, seconds: float) -> str | None:
        """The worker's next line; None if it gives none in this time or has died."""
        assert self._worker is not None
        assert self._worker.stdout is not None
        if not select.select([self._worker.stdout], [], [], seconds)[0]:
            return None
        return self._worker.stdout.readline() or None


# -- in the worker ----------------------------------------------------------------------------------------------


def outcome_of(target: Target, path: Path) -> str:
    """Read one file; empty if that ends well, else what happened."""
    from coupole.errors import CoupoleError

    try:
        target.read(path)
    except CoupoleError as error:
        named = not target.names_file or path.name in str(error) or "small.yaml" in str(error)
        return "" if named else f"names no file: {error!r}"
    except BaseException:  # noqa: BLE001  whatever it is, it is what is looked for
        return traceback.format_exc()[-3000:]
    return ""


def _serve(folder: Path) -> None:
    """Take cases from standard input until it ends."""
    warm = _OF_NAME["mesh-obj"]
    path = _placed(folder, warm, warm.seeds()[0])
    if what := outcome_of(warm, path):
        raise RuntimeError(what)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    answers = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):
        print(json.dumps("ready"), file=answers, flush=True)
        for line in sys.stdin:
            name, seed, number = json.loads(line)
            target = _OF_NAME[name]
            path = _placed(folder, target, case_of(target, seed, number))
            print(json.dumps(outcome_of(target, path)), file=answers, flush=True)


def _placed(folder: Path, target: Target, data: bytes) -> Path:
    path = folder / target.file
    if not path.parent.exists():
        path.parent.mkdir(parents=True)
        if target.beside is not None:
            target.beside(path.parent)
    path.write_bytes(data)
    return path


def main(arguments: list[Any]) -> None:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "configs"
        shutil.copytree(CONFIGS, folder)
        if not arguments:
            _serve(folder)
            return
        name, seed, number = arguments
        target = _OF_NAME[name]
        kept = Path(f"fuzz-case{Path(target.file).suffix}")
        kept.write_bytes(case_of(target, seed, int(number)))
        print(outcome_of(target, _placed(folder, target, kept.read_bytes())) or "ends well")
        print(f"the file is {kept}")


if __name__ == "__main__":
    main(sys.argv[1:])
