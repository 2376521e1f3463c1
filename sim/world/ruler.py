"""Lengths of the simulated cell, mm, as a person would measure them with ruler and tape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform, inverse
from sim.scene.things import CharucoBoard, Thing
from sim.world.config import SceneConfig


class Ruler:
    """Measurements with a ruler: the tool above the disk, the tool itself, disk and dome, and the place of the
    first board."""

    def __init__(self, scene: SceneConfig, things: Sequence[Thing], leds_mm: NDArray[np.float64]) -> None:
        """`leds_mm` [n, 3] are the true places of the LEDs, base frame."""
        self._scene = scene
        self._support_from_base = inverse(np.array(scene.base_from_support))
        self._leds_mm = leds_mm
        self._board = next((thing for thing in things if isinstance(thing, CharucoBoard)), None)

    def lengths_mm(self, base_from_flange: Transform) -> dict[str, float]:
        """Return the lengths by name, for this pose of the flange."""
        tool = [(*end, body.radius_mm) for body in self._scene.tool for end in (body.from_mm, body.to_mm)]
        ends = np.array([(0.0, 0.0, 0.0, 0.0), *tool])
        pose = self._support_from_base @ base_from_flange
        centre_mm = np.array(self._scene.base_from_support)[:3, 3]
        lengths = {
            "tool_over_support_mm": float((ends[:, :3] @ pose[2, :3] + pose[2, 3] - ends[:, 3]).min()),
            "tool_reach_mm": float((ends[:, 2] + ends[:, 3]).max()),
            "tool_width_mm": float((np.hypot(ends[:, 0], ends[:, 1]) + ends[:, 3]).max()),
            "support_diameter_mm": self._scene.support_diameter_mm,
            "dome_radius_mm": float(np.linalg.norm(self._leds_mm - centre_mm, axis=1).min()),
        }
        if self._board is not None:
            x_mm, y_mm, z_mm = self._board.translation_mm
            lengths |= {"board_x_mm": x_mm, "board_y_mm": y_mm, "board_top_mm": z_mm + self._board.thickness_mm}
        return lengths
