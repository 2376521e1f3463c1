"""Frames of a simulated cell without a running world: no clock, no wires, only the rendered image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import Transform
from sim.devices.arm_bodies import NONE, tool_capsules
from sim.devices.camera_body import Exposed
from sim.optics.photographer import Photographer
from sim.world.config import Config


class Stills:
    """A camera at any pose; `config` is the configuration of the world (`sim.world.config.Config`)."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        valid_config = Config.model_validate(config)
        self._photographer = Photographer(valid_config.scene, valid_config.rendered_camera, valid_config.settings)
        self._tool, self._arm_shadows = valid_config.scene.tool, valid_config.settings.arm_shadows
        self._shape = (valid_config.camera.height_px, valid_config.camera.width_px)
        self._taken = 0

    def take(
        self,
        base_from_flange: Transform,
        *,
        leds: Sequence[int],
        panels: Sequence[int],
        exposure_s: float,
        gain: float = 1.0,
    ) -> NDArray[np.uint16]:
        """Return a RAW frame [h, w], DN. The given LEDs and panels are lit for the whole exposure. Only the tool
        of the arm is present.
        """
        pixels = np.empty(self._shape, np.uint16)
        shining = dict.fromkeys(leds, exposure_s)
        tool = tool_capsules(base_from_flange, self._tool) if self._arm_shadows else NONE
        exposure = Exposed(shining, list(panels), exposure_s, gain, self._taken, base_from_flange, tool)
        self._photographer.render(pixels, exposure)
        self._taken += 1
        return pixels
