"""Lamps in the picture, panels, and a dome that is not quite as its table says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scenes import BENT, camera_above
from test_picture import ABOVE, frame, photographer

from coupole.appearance.render.led_squares import Leds
from coupole.geometry import Transform
from sim.devices.camera_body import Exposed
from sim.optics import panels
from sim.optics.dome import DomeErrors, as_built
from sim.optics.glow import glow
from sim.optics.objective import Objective, defocus_px
from sim.optics.panels import Panel
from sim.optics.photographer import Photographer
from sim.render.emitter import irradiance, square
from sim.render.lens import Lens, distorted_points, sight

SIZE = (192, 256)
FLAT, CURVED = (sight(Lens(SIZE[1], SIZE[0], 400.0, d)) for d in ((0.0,) * 5, BENT))
LOOKING_UP = np.eye(4)
EMPTY = np.ones(SIZE, np.float32)


def facing(x_mm: float, y_mm: float, z_mm: float, side_mm: float = 7.0, normal=(0.0, 0.0, -1.0)):  # type: ignore[no-untyped-def]
    return square((x_mm, y_mm, z_mm), normal, side_mm=side_mm, flux_lm=1800.0)


def taken(
    by: Photographer, pose: Transform, exposure_s: float, *, led: int | None = None, panel: int | None = None
) -> np.ndarray:  # type: ignore[type-arg]
    """A frame above black, DN."""
    out = np.zeros((96, 128), np.uint16)
    leds = {} if led is None else {led: exposure_s}
    by.render(out, Exposed(leds, [] if panel is None else [panel], exposure_s, 1.0, 1, pose))
    return out - 64.0


def filled(lamp) -> np.ndarray:  # type: ignore[no-untyped-def]
    whole = np.zeros(SIZE)
    whole[lamp.rows, lamp.columns] = lamp.radiance
    return whole


@pytest.mark.parametrize("through", [FLAT, CURVED], ids=["straight", "bent"])
def test_an_led_is_seen_where_its_centre_is_projected(through) -> None:  # type: ignore[no-untyped-def]
    """The spot is a few pixels wide: perspective shifts its middle by less than a hundredth of one."""
    for x, y in ((0.0, 0.0), (180.0, -120.0), (-250.0, 170.0)):
        lamp = glow(facing(x, y, 1000.0, 20.0), "lambertian", through, LOOKING_UP, EMPTY, None)
        assert lamp is not None
        image = filled(lamp)
        at = [float((image * grid).sum() / image.sum()) for grid in np.indices(SIZE)]
        expected = (
            distorted_points(np.array([x, y]) / 1000.0, through.lens.distortion) * 400.0 + through.lens.centre_px
        )
        assert at[::-1] == pytest.approx(list(expected), abs=0.01)


def test_its_luminance_is_that_of_a_cosine_emitter_and_its_area_that_of_perspective() -> None:
    lamp = glow(facing(0.0, 0.0, 1000.0, 40.0), "lambertian", FLAT, LOOKING_UP, EMPTY, None)
    assert lamp is not None
    assert lamp.radiance.max() == pytest.approx(1800.0 / (np.pi * 0.04**2), rel=1e-6)
    covered = lamp.radiance.sum() / lamp.radiance.max()
    assert covered == pytest.approx((40.0 * 400.0 / 1000.0) ** 2, rel=0.01)


def test_the_light_of_its_picture_is_the_irradiance_it_gives_at_the_lens() -> None:
    """Independent of the projection: the sum over pixels of radiance, solid angle and cosine is Lambert's E."""
    lamp = facing(150.0, 100.0, 900.0, 60.0, normal=(-0.6, 0.0, -0.8))
    seen = glow(lamp, "lambertian", FLAT, LOOKING_UP, EMPTY, None)
    assert seen is not None
    y, x = np.indices(SIZE)
    x, y = (x - FLAT.lens.centre_px[0]) / 400.0, (y - FLAT.lens.centre_px[1]) / 400.0
    solid_angle_cosine = (1.0 + x * x + y * y) ** -2 / 400.0**2
    given = irradiance(lamp, np.zeros(3), np.array([0.0, 0.0, 1.0]))[0]
    assert (filled(seen) * solid_angle_cosine).sum() == pytest.approx(given, rel=2e-3)


def test_an_led_from_behind_or_beyond_the_edge_of_the_picture_is_not_seen() -> None:
    assert glow(facing(0, 0, 1000.0, normal=(0, 0, 1.0)), "lambertian", FLAT, LOOKING_UP, EMPTY, None) is None
    assert glow(facing(900.0, 0, 1000.0), "lambertian", FLAT, LOOKING_UP, EMPTY, None) is None
    assert glow(facing(0, 0, -1000.0, normal=(0, 0, 1.0)), "lambertian", FLAT, LOOKING_UP, EMPTY, None) is None


def test_an_led_is_hidden_by_whatever_else_is_seen() -> None:
    half = EMPTY.copy()
    half[:, : SIZE[1] // 2] = 0.0
    whole, cut = (
        glow(facing(0.0, 0.0, 1000.0, 40.0), "lambertian", FLAT, LOOKING_UP, e, None) for e in (EMPTY, half)
    )
    assert whole is not None
    assert cut is not None
    assert cut.radiance.sum() == pytest.approx(0.5 * whole.radiance.sum(), rel=1e-3)


def test_out_of_focus_a_lamp_keeps_its_light_and_grows_by_the_disk_of_confusion() -> None:
    objective, pitch_um = Objective(), 85.0
    sharp, soft = (
        glow(facing(0.0, 0.0, 1000.0), "lambertian", FLAT, LOOKING_UP, EMPTY, blur)
        for blur in (None, (objective, pitch_um))
    )
    assert sharp is not None
    assert soft is not None
    assert soft.radiance.sum() == pytest.approx(sharp.radiance.sum(), rel=2e-3)
    disk_px = float(defocus_px(objective, 1000.0, pitch_um))
    rows = np.flatnonzero(soft.radiance.any(axis=1))
    assert len(rows) == pytest.approx(7.0 * 0.4 + disk_px, abs=2.5)


# -- panels -----------------------------------------------------------------------------------------------


def test_the_pieces_of_a_panel_give_the_lux_that_was_asked_for() -> None:
    panel = Panel(centre_mm=(700.0, 300.0, 900.0), unevenness=0.1)
    pieces = panels.pieces(panels.whole(panel, np.eye(4), 250.0), panel.unevenness)
    total = sum(float(irradiance(piece, np.zeros(3), np.array([0.0, 0.0, 1.0]))[0]) for piece in pieces)
    assert total == pytest.approx(250.0, rel=1e-9)


@pytest.mark.parametrize("shading", ["flat", "pixel"])
def test_a_panel_casts_a_soft_shadow(shading: str, tmp_path: Path) -> None:
    """Where LED 9's shadow has a hard edge, that of a panel of 600 mm at its place has a wide one."""
    world = {"panels": [{"centre_mm": (0.0, -900.0, 900.0), "side_mm": 600.0}], "shading": shading}
    by = photographer(tmp_path, world)
    profiles = [taken(by, ABOVE, 0.4, **lit)[0:47, 60:68].mean(axis=1) for lit in ({"led": 9}, {"panel": 1})]
    steps = [np.abs(np.diff(profile)).max() / np.ptp(profile) for profile in profiles]
    assert steps[1] < 0.6 * steps[0]


def test_a_panel_in_the_picture_is_evenly_bright(tmp_path: Path) -> None:
    world = {"panels": [{"centre_mm": (0.0, 0.0, 900.0), "side_mm": 900.0}]}
    by = photographer(tmp_path, world)
    up = np.diag([1.0, 1.0, 1.0, 1.0])
    up[2, 3] = 200.0
    picture = taken(by, up, 0.001, panel=1)
    middle, beside = picture[40:56, 56:72].mean(), picture[40:56, 20:36].mean()
    assert 500.0 < middle < 3500.0
    tangent = 36.0 * 176e-3 / (35.0 / (1 - 35.0 / 335.0))
    assert beside / middle == pytest.approx((1.0 + tangent**2) ** -2, rel=0.01)


# -- the dome ---------------------------------------------------------------------------------------------


def dome(boards: int = 200) -> Leds:
    random = np.random.default_rng(3)
    at = random.normal(size=(boards, 1, 3)) * 1000.0 + random.normal(size=(boards, 6, 3)) * 60.0
    return Leds(
        np.arange(6 * boards),
        np.repeat(np.arange(boards), 6),
        at.reshape(-1, 3),
        np.tile([0.0, 0.0, -1.0], (6 * boards, 1)),
        np.full(6 * boards, 1800.0),
    )


def test_a_dome_without_errors_is_its_table() -> None:
    table = dome(5)
    built = as_built(table, DomeErrors())
    assert np.allclose(built.positions_mm, table.positions_mm, atol=1e-9)
    assert np.array_equal(built.normals, table.normals)


def test_boards_are_moved_as_rigid_bodies_by_what_was_asked_for() -> None:
    table, errors = dome(), DomeErrors(board_shift_mm=2.0, board_turn_deg=0.3)
    built = as_built(table, errors)
    distances = [
        np.linalg.norm(p.reshape(-1, 6, 1, 3) - p.reshape(-1, 1, 6, 3), axis=-1)
        for p in (table.positions_mm, built.positions_mm)
    ]
    assert np.allclose(*distances)
    shift = (built.positions_mm - table.positions_mm).reshape(-1, 6, 3).mean(axis=1)
    assert shift.std() == pytest.approx(2.0, rel=0.1)
    tilt_deg = np.degrees(np.arccos((built.normals[::6] * table.normals[::6]).sum(axis=1)))
    assert np.sqrt(np.mean(tilt_deg**2)) == pytest.approx(0.3 * np.sqrt(2), rel=0.15)


def test_swapped_leds_light_from_each_others_places() -> None:
    table = dome(5)
    built = as_built(table, DomeErrors(swapped=((3, 17),)))
    assert np.allclose(built.positions_mm[[3, 17]], table.positions_mm[[17, 3]])
    assert np.allclose(built.positions_mm[4:17], table.positions_mm[4:17])


def test_a_dome_is_the_same_for_the_same_seed_alone() -> None:
    table = dome(5)
    first, again, other = (
        as_built(table, DomeErrors(seed=seed, board_shift_mm=1.0)).positions_mm for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


def test_leds_with_colours_of_their_own_tint_what_they_light(tmp_path: Path) -> None:
    plain, tinted = photographer(tmp_path), photographer(tmp_path, {"leds": {"pump_spread_nm": 5.0}})
    shares = [
        [float(frame(by, {led: 0.004}, ABOVE)[0::2, 0::2].mean() - 64.0) for led in (0, 7)]
        for by in (plain, tinted)
    ]
    assert shares[0] != pytest.approx(shares[1], rel=1e-3)
    assert shares[0] == pytest.approx(shares[1], rel=0.1)


def test_blur_leaves_an_even_picture_as_it_is_and_softens_edges(tmp_path: Path) -> None:
    sharp, soft = (photographer(tmp_path, blur=blur, f_number=2.0) for blur in (False, True))
    near = camera_above(200.0)
    pictures = [frame(by, {0: 0.01}, near).astype(float) for by in (sharp, soft)]
    assert pictures[1].mean() == pytest.approx(pictures[0].mean(), rel=0.05)
    edges = [np.abs(np.diff(picture[40:56:2, ::2], axis=1)).max() for picture in pictures]
    assert edges[1] < 0.6 * edges[0]
