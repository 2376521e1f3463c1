"""The angles of the how-to turn the axes that it names upwards, by another program's rotations."""

from __future__ import annotations

import re

import numpy as np
from places import REPO
from scipy.spatial.transform import Rotation

AXES = {sign + name: (-1 if sign else 1) * np.eye(3)[n] for n, name in enumerate("xyz") for sign in ("", "-")}


def test_a_mesh_stands_upright_by_the_angles_of_its_row() -> None:
    text = (REPO / "docs/how-to/place-a-mesh.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (-?[xyz])\b.* \| `\[(.*?)\]` \|$", text, re.MULTILINE)
    assert {axis for axis, _ in rows} == set(AXES)
    for axis, angles in rows:
        a, b, c = map(float, angles.split(","))
        upwards = Rotation.from_euler("ZYX", [a, b, c], degrees=True).apply(AXES[axis])
        assert np.allclose(upwards, [0, 0, 1]), axis
