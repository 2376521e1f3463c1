"""Plans and rigs with any value at any place are read, or refused at a line of the file."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fuzz.test_fuzz import SEED
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from places import REPO
from pydantic import BaseModel
from ruamel.yaml import YAML

from coupole.plan.plan import Plan
from coupole.plan.rig import Rig
from coupole.plan.yamlfile import read_document

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([0, -1, 2**63, 10**40, 1e308, 5e-324, "", "\0", "~x/y", "a" * 300, ".", "/"])
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)
DOCUMENTS = [
    (Plan, YAML(typ="safe", pure=True).load(REPO / "configs/plans/demo.yaml")),
    (Rig, YAML(typ="safe", pure=True).load(REPO / "configs/rigs/sim.yaml")),
]


def places_of(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all values in a document, but of the document itself."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, below in inner for place in [(*at, key), *places_of(below, (*at, key))]]


def replaced(document: Any, place: tuple[Any, ...], value: Any) -> Any:
    changed = copy.deepcopy(document)
    part = changed
    for step in place[:-1]:
        part = part[step]
    part[place[-1]] = value
    return changed


@pytest.mark.parametrize(("model", "document"), DOCUMENTS, ids=["plan", "rig"])
def test_any_value_anywhere_is_read_or_refused_at_its_line(
    tmp_path: Path, scale: Callable[[int, int], int], model: type[BaseModel], document: Any
) -> None:
    path = tmp_path / "case.yaml"

    @seed(SEED)
    @settings(
        max_examples=scale(40, 1000), database=None, suppress_health_check=list(HealthCheck), print_blob=True
    )
    @given(st.sampled_from(places_of(document)), VALUES)
    def check(place: tuple[Any, ...], value: Any) -> None:
        path.write_text(json.dumps(replaced(document, place, value), indent=1))
        from coupole.errors import InputError

        try:
            found, problems = read_document(path).problems(model)
        except InputError as error:
            found, problems = None, list(error.problems)
        assert (found is None) == bool(problems)
        assert all(problem.file == str(path) and problem.line > 0 for problem in problems), problems

    check()
