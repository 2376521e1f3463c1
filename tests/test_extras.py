"""What is told of a library that is not installed."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from importlib import metadata
from importlib.util import find_spec

import pytest
from places import REPO

from coupole.commands.extras import EXTRA_OF, missing_extra

DECLARED = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]["optional-dependencies"]
NEIGHBOURS = {"bluesky", "napari"}
"""Installed with a group of their own (`prepare_tests`), or not."""
FOR_DRIVERS = {"aravis", "gentl", "ur"}
"""Drivers tell themselves what they lack."""


packages_distributions = cache(metadata.packages_distributions)


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def installed_by(library: str) -> set[str]:
    """Names of the distributions that hold a module; of one that lists none, the module's own."""
    names = packages_distributions().get(library, [library] if find_spec(library) else [])
    return {normal(name) for name in names}


def distributions(extra: str) -> set[str]:
    """Names of what an extra installs, itself and by other extras."""
    names: set[str] = set()
    for requirement in DECLARED[extra]:
        if of_others := re.fullmatch(r"coupole\[(.+)\]", requirement):
            for other in of_others[1].split(","):
                names |= distributions(other)
        else:
            names.add(normal(re.split(r"[<>=;\[ ]", requirement)[0]))
    return names


@pytest.mark.parametrize("library", sorted(EXTRA_OF))
def test_the_named_extra_installs_the_library(library: str) -> None:
    if EXTRA_OF[library] in NEIGHBOURS and find_spec(library) is None:
        pytest.skip(f"{library} is not installed here")
    assert installed_by(library) & distributions(EXTRA_OF[library])


@pytest.mark.parametrize("extra", sorted(set(DECLARED) - FOR_DRIVERS))
def test_each_library_of_an_extra_has_a_name_to_tell(extra: str) -> None:
    if extra in NEIGHBOURS and find_spec("bluesky") is None:
        pytest.skip(f"the extra {extra} is not installed here")
    assert distributions(extra) <= set().union(*map(installed_by, EXTRA_OF))


def test_a_library_of_no_extra_is_a_defect() -> None:
    assert missing_extra(ModuleNotFoundError("No module named 'coupole.plam'", name="coupole.plam")) is None
    missing = missing_extra(ModuleNotFoundError("No module named 'cv2.aruco'", name="cv2.aruco"))
    assert missing is not None
    assert "pip install 'coupole[pictures]'" in str(missing)
