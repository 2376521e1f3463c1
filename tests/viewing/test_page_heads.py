"""What is said of every page and every message, wherever it is made."""

from __future__ import annotations

import re

import pytest
from places import REPO

from coupole.errors import InputError, reason
from coupole.storage.run import Run


def test_every_page_has_its_language_and_fits_a_telephone() -> None:
    heads = []
    for path in [*(REPO / "coupole").rglob("*.py"), *(REPO / "coupole").rglob("*.html")]:
        joined = re.sub(r"""["']\n\s*f?["']""", "", path.read_text(encoding="utf-8"))
        heads += [(path.name, joined[found.start() :][:400]) for found in re.finditer("<!doctype html>", joined)]
    assert len(heads) >= 4
    assert [name for name, head in heads if not re.search(r'<html lang="?en"?>', head)] == []
    assert [name for name, head in heads if not re.search('<meta name="?viewport"?', head)] == []


def test_messages_have_the_systems_words_and_not_its_numbers() -> None:
    assert reason(BlockingIOError(11, "Resource temporarily unavailable")) == "Resource temporarily unavailable"
    assert reason(ValueError("no JSON")) == "no JSON"
    with pytest.raises(InputError, match=r"nowhere: not a run folder: it has no run\.json"):
        Run(REPO / "nowhere")
