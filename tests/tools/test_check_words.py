"""Bare names and fragments are found where they are, and nowhere else; a share above its bound fails."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest
from places import REPO

sys.path.insert(0, str(REPO / "tools"))

import check_words


@pytest.mark.parametrize("name", ["found", "mine", "_kept", "asked", "what", "turned"])
def test_a_participle_or_pronoun_alone_says_nothing(name: str) -> None:
    assert check_words.is_bare(name)


@pytest.mark.parametrize("name", ["led", "speed", "found_leds", "is_kept", "exposure_us", "red", "frames"])
def test_a_name_that_says_what_it_holds_passes(name: str) -> None:
    assert not check_words.is_bare(name)


def test_names_and_docstrings_are_found_wherever_they_are_bound() -> None:
    tree = ast.parse(
        '"""Module."""\n'
        "import x as given\n"
        "class Frame:\n"
        '    """Of a view."""\n'
        "    shown: int = 0\n"
        '    """Where it is."""\n'
        "def read(asked, *, kept=1):\n"
        '    """Read it."""\n'
        "    for told in asked:\n"
        "        made = (seen := told)\n"
    )
    names = {name for name, _ in check_words.bound_names(tree) if check_words.is_bare(name)}
    assert names == {"given", "shown", "read", "asked", "kept", "told", "made", "seen"}
    texts = [text for text, _ in check_words.docstrings(tree)]
    assert sorted(texts) == ["Module.", "Of a view.", "Read it.", "Where it is."]
    assert [text for text in texts if check_words.FRAGMENT.match(text)] == ["Of a view.", "Where it is."]


def test_a_room_above_its_bound_fails_and_names_each_case(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "drivers").mkdir()
    (tmp_path / "drivers" / "box.py").write_text('"""A box."""\nfound = 1\n')
    bounds = '[words]\npronouns = ""\nparticiples = "found"\nno_participles = ""\n[most_percent]\nelse = '
    (tmp_path / "words.toml").write_text(bounds + "{names = 1.0, fragments = 4.0}\n")
    check_words.words.cache_clear()
    monkeypatch.setattr(check_words, "ROOT", tmp_path)
    monkeypatch.setattr(check_words, "WORDS", tmp_path / "words.toml")
    monkeypatch.setattr(sys, "argv", ["check_words.py", "--show"])
    assert check_words.main() == 1
    assert "drivers/box.py:2: found" in capsys.readouterr().out
    (tmp_path / "words.toml").write_text(bounds + "{names = 100.0, fragments = 4.0}\n")
    assert check_words.main() == 0
    check_words.words.cache_clear()
