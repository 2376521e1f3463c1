"""The tool that tries mutants: on a small project of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

from mutants import EQUIVALENT, KILLED, SURVIVED, Mutant, Stale, judge_all, read_mutants, stale, table

ROOT = Path(__file__).resolve().parents[2]
CODE = "def largest(a: int, b: int) -> int:\n    return a if a > b else b\n"
TEST = "from small import largest\n\n\ndef test_largest() -> None:\n    assert largest(1, 2) == 2\n"


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # the tool starts pytest often
    root = tmp_path / "project"
    root.mkdir()
    (root / "small.py").write_text(CODE)
    (root / "test_small.py").write_text(TEST)
    subprocess.run(["git", "init", "-q"], cwd=root, check=True)
    return root


def mutant(name: str, old: str, new: str, **more: str) -> Mutant:
    return Mutant(name, "small.py", old, new, "", ("test_small.py",), **more)


REVERSED = mutant("reversed", "a > b", "a < b")
NEVER_EQUAL = mutant("or-equal", "a > b", "a >= b", equivalent="equal numbers are the same")
UNSEEN = mutant("doubled", "return a if", "return 2 * a if")


def test_a_mutant_is_killed_by_a_failing_test_and_survives_passing_ones(project: Path, tmp_path: Path) -> None:
    given = [REVERSED, UNSEEN, NEVER_EQUAL]
    verdicts, troubles = judge_all(given, project, tmp_path / "results", again=False)
    assert troubles == []
    assert [verdict.outcome for verdict in verdicts] == [KILLED, SURVIVED, EQUIVALENT]
    assert verdicts[0].noticed_by == "test_small.py::test_largest"
    assert (project / "small.py").read_text() == CODE
    assert "1 of 2 killed (50.0%), 1 equivalent" in table(verdicts, given)


def test_a_script_that_a_test_begins_sees_the_mutant(project: Path, tmp_path: Path) -> None:
    """Also elsewhere than in the project's folder, which alone is on the path of a script."""
    (project / "scripts").mkdir()
    (project / "scripts/ask.py").write_text("from small import largest\n\nprint(largest(1, 2))\n")
    (project / "test_small.py").write_text(
        "import subprocess, sys\n\n\ndef test_largest() -> None:\n"
        "    asked = subprocess.run([sys.executable, 'scripts/ask.py'], capture_output=True, text=True)\n"
        "    assert asked.stdout == '2\\n', asked\n"
    )
    (verdict,), troubles = judge_all([REVERSED], project, tmp_path / "results", again=False)
    assert troubles == []
    assert verdict.outcome == KILLED
    assert verdict.noticed_by == "test_small.py::test_largest"


def test_verdicts_are_used_again_until_code_or_tests_change(project: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    judge_all([REVERSED], project, results, again=False)
    (line,) = results.read_text().splitlines()
    results.write_text(json.dumps(json.loads(line) | {"outcome": SURVIVED}) + "\n" + line[:20])
    verdicts, _ = judge_all([REVERSED], project, results, again=False)
    assert verdicts[0].outcome == SURVIVED
    (project / "test_small.py").write_text(TEST + "# changed\n")
    verdicts, _ = judge_all([REVERSED], project, results, again=False)
    assert verdicts[0].outcome == KILLED


def test_tests_that_fail_without_a_mutant_judge_nothing(project: Path, tmp_path: Path) -> None:
    (project / "test_small.py").write_text(TEST.replace("== 2", "== 3"))
    verdicts, troubles = judge_all([REVERSED], project, tmp_path / "results", again=False)
    assert verdicts == []
    assert "fail without any mutant" in troubles[0]


def test_a_mutant_that_does_not_fit_the_code_is_told(project: Path, tmp_path: Path) -> None:
    gone, same = mutant("gone", "a == b", "a"), mutant("same", "a > b", "a > b")
    assert len(stale([gone, same, REVERSED], project)) == 2
    _, troubles = judge_all([gone], project, tmp_path / "results", again=False)
    assert "0 times in small.py" in troubles[0]


def test_a_name_that_comes_twice_is_refused(tmp_path: Path) -> None:
    entry = '[[file]]\npath = "a"\ntests = ["t"]\nmutant = [{ name = "n", old = "a", new = "b", harm = "h" }]\n'
    (tmp_path / "one.toml").write_text(entry)
    (tmp_path / "two.toml").write_text(entry)
    with pytest.raises(Stale, match="twice: n"):
        read_mutants(tmp_path)


def test_there_are_150_mutants_each_with_the_harm_it_does() -> None:
    mutants = read_mutants(ROOT / "tools" / "mutants")
    assert len(mutants) >= 150
    assert all(one.harm and one.tests for one in mutants)
    assert len([one for one in mutants if one.equivalent]) < len(mutants) / 10
