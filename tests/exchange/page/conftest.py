"""One browser, and one page, for all tests of this folder; `tests/conftest.py` gives them to one worker."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from relight_cases import GLOSSY, waves, write_result
from shown_page import Page, opened_page

from coupole.exchange.look.look_of_runs import look_of_result
from coupole.exchange.look.look_page import write_page


@pytest.fixture(scope="session")
def page() -> Iterator[Page]:
    with opened_page() as page:
        yield page


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`result` and its `look.html`."""
    folder = tmp_path_factory.mktemp("look")
    write_result(folder / "result", waves(), GLOSSY)
    write_page(look_of_result(folder / "result"), "waves", folder / "look.html")
    return folder
