"""A result with texels for all modules `test_texel*`; `tests/conftest.py` gives them to one worker."""

from __future__ import annotations

import pytest
from relief_cells import Made, detailed_result


@pytest.fixture(scope="session")
def detailed(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return detailed_result(tmp_path_factory.mktemp("detailed"))
