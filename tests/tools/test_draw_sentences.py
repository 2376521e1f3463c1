"""Whole sentences are drawn, each once, from where a reader meets them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from places import REPO

sys.path.insert(0, str(REPO / "tools"))

import draw_sentences
from draw_sentences import Sentence

PAGE = """# A heading that is no sentence

The box lights one LED, e.g. LED 417, for 1.5 ms. [The camera](camera.md) takes
one frame of 12.3 megapixels! Too short.

- Each item of a list is a paragraph.

| key | meaning |
|---|---|
| `led` | the LED that the box lights now |

```
This is code and not a sentence.
```
"""

SOURCE = '''"""This module says what it is."""

def light(led: Annotated[int, typer.Option(help="Number of the LED to be lit.")]) -> None:
    """Light one LED of the cell.

    It ends with 2 if there is no such LED.
    """
    raise ValueError(f"LED {led}: is not one of the dome's; "
        "it has 1080")

def helper() -> None:
    """Return what the helper of a command returns."""
    style = "<b>Markup is not a sentence that is drawn</b>"
'''


def test_paragraphs_lists_and_cells_are_cut_into_whole_sentences() -> None:
    cut = [
        text
        for _, paragraph in draw_sentences.paragraphs_of_page(PAGE)
        for text in draw_sentences.sentences(paragraph)
    ]
    assert cut == [
        "The box lights one LED, e.g. LED 417, for 1.5 ms.",
        "The camera takes one frame of 12.3 megapixels!",
        "Each item of a list is a paragraph.",
        "the LED that the box lights now",
    ]


def test_text_of_a_notebook_has_its_lines() -> None:
    notebook = "x = 1\n# %% [markdown]\n# ## Heading\n#\n# The frame has one dark border.\n# %%\n# This is code.\n"
    assert list(draw_sentences.paragraphs_of_notebook(notebook)) == [(5, "The frame has one dark border.")]


def test_help_and_messages_are_apart_from_docstrings() -> None:
    said = [text for _, text in draw_sentences.messages("import typer\n" + SOURCE)]
    assert {"Number of the LED to be lit.", "LED {led}: is not one of the dome's; it has 1080"} <= set(said)
    assert "Light one LED of the cell." in said
    assert not [text for text in said if "Markup" in text or "helper" in text or "module" in text]
    assert [text for _, text in draw_sentences.docstrings("import typer\n" + SOURCE)] == [
        "This module says what it is.",
        "Return what the helper of a command returns.",
    ]


def test_a_seed_draws_the_same_sentences_each_once() -> None:
    every = [Sentence(f"page.md:{line}", f"sentence {line}") for line in range(100)]
    drawn = draw_sentences.draw(every, 1, 40)
    assert drawn == draw_sentences.draw(every, 1, 40) != draw_sentences.draw(every, 2, 40)
    assert len(set(drawn)) == 40
    assert len(draw_sentences.draw(every, 1, 200)) == 100


@pytest.mark.parametrize(
    ("kind", "below"), [("docs", "docs/how-to"), ("messages", "coupole/plan"), ("docstrings", "drivers")]
)
def test_forty_sentences_of_this_project_are_printed_with_their_places(kind: str, below: str) -> None:
    command = [sys.executable, "tools/draw_sentences.py", "--of", kind, "--seed", "5", below]
    lines = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines) == 81
    assert lines[-1].startswith("40 of ")
    place, _, line = lines[0].split()[1].rpartition(":")
    assert place.startswith(below)
    assert Path(REPO / place).is_file()
    assert int(line) > 0
