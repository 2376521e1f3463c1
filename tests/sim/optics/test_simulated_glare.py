"""The simulated camera's veiling glare: its size, its parts, and that nothing changes without it."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from sim.optics.glare import Glare
from sim.world.config import Settings

SIZE_PX = (320, 240)
CHANNELS = np.array([[1, 2], [0, 1]])


def test_a_black_point_in_the_middle_of_white_has_the_share_of_its_channel() -> None:
    glare = Glare(share=(0.005, 0.01, 0.02))
    white = np.full(SIZE_PX[::-1], 10_000.0, np.float32)
    white[118:122, 158:162] = 0.0
    seen = glare.over(white, CHANNELS)
    for number, (row, column) in enumerate(((121, 160), (120, 160), (120, 161))):
        assert seen[row, column] / 1e4 == pytest.approx(glare.share[number], rel=0.03)
        assert glare.of_white(SIZE_PX, number)[120, 160] == pytest.approx(glare.share[number], rel=0.03)


def test_a_spot_makes_haze_everywhere_a_lobe_about_it_and_a_turned_ghost() -> None:
    spot = np.zeros(SIZE_PX[::-1], np.float32)
    spot[60:64, 80:84] = 1e6
    whole = np.ones((2, 2), np.bool_)
    haze = Glare(haze=1.0, ghost=0.0).scattered_light(spot, whole)
    assert np.ptp(haze) < 1e-6 * haze.max()
    assert haze.mean() == pytest.approx(spot.mean(), rel=1e-3)
    lobe = Glare(haze=0.0, ghost=0.0, core=0.05, falls_by=3.0).scattered_light(spot, whole)
    assert np.unravel_index(lobe.argmax(), lobe.shape) == pytest.approx((61, 81), abs=2)
    assert lobe[61, 81 + 160] / lobe[61, 81 + 80] == pytest.approx(((1 + 25) / (1 + 100)) ** 1.5, rel=0.05)
    ghost = Glare(haze=0.0, ghost=1.0).scattered_light(spot, whole)
    assert np.unravel_index(ghost.argmax(), ghost.shape) == pytest.approx((178, 238), abs=3)


def test_light_of_one_channel_makes_glare_in_that_channel_alone() -> None:
    red = np.zeros(SIZE_PX[::-1], np.float32)
    red[1::2, 0::2] = 1e4
    seen = Glare().over(red, CHANNELS)
    assert seen[1::2, 0::2].mean() > 1.004e4
    assert not np.delete(seen.reshape(120, 2, 160, 2).transpose(1, 3, 0, 2).reshape(4, -1), 2, axis=0).any()


def test_a_rig_has_none_by_default_and_refuses_shares_that_are_more_than_one() -> None:
    assert Settings().glare is None
    assert Settings.model_validate({"glare": {}}).glare == Glare()
    with pytest.raises(ValidationError, match="no more than 1 together"):
        Glare(haze=0.7, ghost=0.4)
