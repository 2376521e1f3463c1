"""Veiling glare: found by black traps beside white, taken off other scenes, refused where it cannot be told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import typer
from glare_scenes import SENSOR, SHAPE, SIZE_PX, WHITE_E, black_beside_white, card_run, card_views, with_glare
from light_runs import Taken, write_light_run
from typer.testing import CliRunner

from coupole.calibration.acceptance import parse_limits
from coupole.calibration.light.acceptance import GLARE
from coupole.calibration.light.frames import channel_mask, open_light_frames
from coupole.calibration.light.glare_correction import read_glare
from coupole.calibration.light.glare_fit import TrapLight, fit_glare, trap_view
from coupole.calibration.light.glare_records import glare_outcome
from coupole.calibration.light.glare_traps import find_traps
from coupole.calibration.light.veil import (
    PARTS,
    at_pixels,
    block_px_of,
    light_of_blocks,
    of_white,
    parts_of,
    veil_of,
)
from coupole.calibration.record import Record, read_record, write_record
from coupole.calibration.request import Request
from coupole.commands import calibrate_light
from coupole.errors import CalibrationRefused, InputError
from sim.optics.glare import Glare

PLACES = {"middle": (191, 143), "corner": (0, 0), "side": (0, 143)}
MASKS = {channel: channel_mask(SHAPE, "GBRG", channel) for channel in "RGB"}
LOOSE = ("--limit", "form=0.2")
"""384 x 288 pixels have more noise than a camera's."""


def by_command(folder: Path, run: Path, *arguments: str | Path) -> Record:
    """The record that the command makes of a run. Raises what it raises, but for limits that are exceeded."""
    app = typer.Typer()
    app.command()(calibrate_light.glare)
    words = [str(word) for word in (run, "--out", folder, "--name", "x", *arguments)]
    result = CliRunner().invoke(app, words)
    if result.exception is not None and not isinstance(result.exception, CalibrationRefused):
        raise result.exception
    return read_record(folder / "x.yaml")


def calibrate(folder: Path, run: Path, target: Path | None = None) -> Record:
    """The record alone: half of the command's time goes into its report."""
    request = Request("x", datetime.now(UTC), 365, limits=parse_limits(LOOSE[1:], GLARE))
    outcome = glare_outcome(open_light_frames([run]), request, target, None, None, lambda *_: None)
    folder.mkdir(exist_ok=True)
    write_record(folder / "x.yaml", outcome.record)
    return outcome.record


@pytest.mark.parametrize(
    ("share", "form"), [(0.005, {}), (0.01, {}), (0.02, {}), (0.01, {"haze": 0.7, "ghost": 0.1})]
)
def test_glare_is_found_within_a_tenth_of_a_percentage_point_at_several_places(
    tmp_path: Path, share: float, form: dict[str, float], scale: Callable[[int, int], int]
) -> None:
    glare = Glare(share=(share, share, 0.7 * share), **form)
    over_u = []
    for seed in range(scale(1, 12)):
        record = calibrate(tmp_path / f"{seed}", card_run(tmp_path / f"run{seed}", glare, seed))
        for place, (x, y) in PLACES.items():
            for number, channel in enumerate("RGB"):
                truth = glare.of_white(SIZE_PX, number)[y, x]
                off = record.fixed[f"veil_{place}.{channel}"] - truth
                assert abs(off) < 0.001
                over_u.append(off / record.fixed[f"u_veil_{place}.{channel}"])
    assert np.mean(np.abs(over_u) < 1.96) > 0.9
    assert np.sqrt(np.mean(np.square(over_u))) < 1.5


@pytest.mark.parametrize("share", [0.005, 0.01, 0.02])
def test_black_beside_white_is_right_within_a_thousandth_of_white(tmp_path: Path, share: float) -> None:
    glare = Glare(share=(share, share, share))
    run = card_run(tmp_path / "run", glare)
    calibrate(tmp_path, run)
    correction = read_glare(tmp_path / "x.yaml", open_light_frames([run]))
    random = np.random.default_rng(7)
    over_u = []
    for name, light in black_beside_white().items():
        frames = [SENSOR.frame(with_glare(light, glare), 0.008, random) for _ in range(6)]
        signal = np.mean(frames, axis=0) - 64.0 - 30.0 * 0.008 / 3.2
        clean = correction.without_veil(signal, MASKS)
        for channel, mask in MASKS.items():
            black = mask & (light == 0.0)
            white_dn = WHITE_E / 3.2
            before, after = signal[black].mean() / white_dn, clean[black].mean() / white_dn
            assert 0.2 * share < before < 1.1 * share, name
            assert abs(after) < 0.001, name
            _, u_veil = correction.veil(
                light_of_blocks(signal, mask, correction.block_px), correction.channels.index(channel)
            )
            over_u.append(after / np.hypot(u_veil * before, 2e-5))
    assert np.mean(np.abs(over_u) < 1.96) > 0.85, np.round(over_u, 2)


def test_without_glare_none_is_found(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no more light than their own"):
        calibrate(tmp_path, card_run(tmp_path / "run", None), described(tmp_path, 0.002))


def test_a_veil_that_one_view_alone_shows_is_refused_by_a_figure_that_is_a_number() -> None:
    """Without that view none is predicted, of which nothing is a share."""
    views = []
    for number, light in enumerate(card_views()):
        signal = light.astype(np.float32)
        view = trap_view(f"v{number}", signal, MASKS["G"], find_traps(signal))
        views.append(replace(view, dark=view.beside * (0.01 if number == 0 else 1e-4)))
    fit = fit_glare(views, TrapLight(3e-4, 0.0), "G")
    assert 0.2 < fit.u_form < np.inf


def described(folder: Path, trap_share: float) -> Path:
    path = folder / "target.yaml"
    path.write_text(f"name: my card\ncertificate: laboratory A\ntrap_share: {trap_share}\nu_trap_share: 0.0001\n")
    return path


def test_the_traps_own_light_is_no_glare_and_its_uncertainty_counts(tmp_path: Path) -> None:
    run = card_run(tmp_path / "run", Glare())
    usual = calibrate(tmp_path / "a", run)
    other = by_command(tmp_path / "b", run, *LOOSE, "--target", described(tmp_path, 0.002))
    assert usual.fixed["veil_middle.G"] - other.fixed["veil_middle.G"] == pytest.approx(0.0017, rel=0.3)
    assert any("my card, laboratory A" in remark for remark in other.remarks)
    assert any(line.name == "target.yaml" for line in other.inputs)


def test_views_that_tell_nothing_are_refused_with_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found 16 traps in 2 views"):
        calibrate(tmp_path, card_run(tmp_path / "few", Glare(), views=2))
    with pytest.raises(InputError, match="saturated pixels"):
        calibrate(tmp_path, card_run(tmp_path / "bright", Glare(), scale=2.0))
    empty = [Taken("v/dark0/e0", 8000, np.eye(4), SENSOR.frame(0.0, 0.008, np.random.default_rng(1)))]
    with pytest.raises(InputError, match="no frame with light"):
        calibrate(tmp_path, write_light_run(tmp_path / "dark", empty))
    with pytest.raises(InputError, match="trap_share"):
        calibrate(tmp_path, card_run(tmp_path / "run", Glare(), views=3), described(tmp_path, 0.5))


def test_a_record_beyond_its_limits_is_refused_and_names_them(tmp_path: Path) -> None:
    run = card_run(tmp_path / "run", Glare())
    record = by_command(tmp_path, run, "--limit", "veil=1e-6")
    assert not record.is_accepted
    with pytest.raises(InputError, match="uncertainty of the veil"):
        read_glare(tmp_path / "x.yaml", open_light_frames([run]))


def test_a_dark_place_that_white_does_not_surround_is_no_trap() -> None:
    full, _, _, _, right, *_ = card_views()
    assert len(find_traps(full.astype(np.float32))) == 9
    assert len(find_traps(right.astype(np.float32))) == 3
    with_spot = full.copy()
    with_spot[142:146, 190:194] = 1.0
    assert len(find_traps(with_spot.astype(np.float32))) == 8
    grey = full.copy()
    grey[:, 260:] *= 0.25
    assert len(find_traps(grey.astype(np.float32))) == 6


def test_a_veil_of_known_shares_is_solved_for_to_a_millionth() -> None:
    shares = np.array([0.01, 0.004, 0.006, 0.008, 0.012])
    light = card_views()[4]
    own = light_of_blocks(light, np.ones(SHAPE, bool), 2)
    veil = np.tensordot(shares, parts_of(own, 192.0), axes=1)
    np.testing.assert_allclose(veil_of(own + veil, shares, 192.0), veil, atol=2e-6)


def test_a_point_of_light_spreads_by_each_part_as_wide_as_it_says() -> None:
    light = np.zeros((72, 96))
    light[30, 40] = 1.0
    parts = dict(zip(PARTS, parts_of(light, 96.0), strict=True))
    np.testing.assert_allclose(parts["even"], 1.0 / light.size)
    rows, columns = np.mgrid[:72, :96]
    for name, place, spread_blocks in (
        ("near", (30, 40), 2.88),
        ("middle", (30, 40), 7.68),
        ("turned", (41, 55), 9.6),
    ):
        assert parts[name].sum() == pytest.approx(1.0, abs=0.01)
        middle = np.average(rows, weights=parts[name]), np.average(columns, weights=parts[name])
        assert middle == pytest.approx(place, abs=0.1)
        square = np.average((columns - place[1]) ** 2, weights=parts[name])
        assert np.sqrt(square) == pytest.approx(spread_blocks, rel=0.03)
    light[30, 40], light[0, 0] = 0.0, 1.0
    at_corner = dict(zip(PARTS, parts_of(light, 96.0), strict=True))
    assert at_corner["middle"].sum() == pytest.approx(0.276, abs=0.01)  # half in each direction, and its own block


def test_values_of_blocks_are_linear_between_their_middles() -> None:
    assert [block_px_of(width) for width in (128, 512, 4096)] == [2, 6, 42]
    blocks = np.arange(12.0).reshape(3, 4)
    rows, columns = np.array([1, 3, 3, 11]), np.array([1, 3, 5, 15])
    np.testing.assert_allclose(at_pixels(blocks, rows, columns, 4), [0.0, 1.875, 2.375, 11.0])


def test_a_white_picture_has_all_of_a_part_that_is_the_same_everywhere_and_half_of_others_at_its_sides() -> None:
    middle, side = of_white((512, 384), np.array([[255.0, 191.0], [0.0, 191.0]]))
    assert middle[0] == pytest.approx(side[0])
    np.testing.assert_allclose(middle[3:], 1.0, atol=0.02)
    np.testing.assert_allclose(side[3:], 0.5, atol=0.1)
