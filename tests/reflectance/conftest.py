"""A result of pictures for all modules `test_picture*`; `tests/conftest.py` gives them to one worker."""

from __future__ import annotations

import pytest
from picture_cases import Made, made_result


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return made_result(tmp_path_factory.mktemp("ball"))
