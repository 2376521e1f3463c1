"""What a calibration of the LEDs leaves: a record that holds, the dome's new table, uncertainties, remarks."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
from domes import SIZE_PX, Dome, Noise, dome
from test_led_matching import rewired

from coupole.calibration.leds.drawing import draw_leds
from coupole.calibration.leds.equations import Stated
from coupole.calibration.leds.matching import LedSightings
from coupole.calibration.leds.sources import LedImages
from coupole.calibration.leds.workflow import LedsFound, leds_from
from coupole.calibration.optics import Intrinsics
from coupole.calibration.record import read_record
from coupole.calibration.report import Outcome, write_outcome
from coupole.calibration.request import Request
from coupole.calibration.sources import About
from coupole.errors import InputError
from coupole.plan.led_table import read_led_table

REQUEST = Request("leds-test", datetime(2026, 5, 1, tzinfo=UTC))


def images(made: Dome) -> LedImages:
    names = tuple(f"v{number}" for number in range(len(made.base_from_flange)))
    inputs = (("run/run.json", "0" * 64),)
    return LedImages(made.seen, made.base_from_flange, names, SIZE_PX, (), About(is_simulated=True), inputs)


def found(made: Dome, *, accept_faults: bool = False, limits: Mapping[str, float] | None = None) -> LedsFound:
    request = replace(REQUEST, limits=limits or {})
    return leds_from(
        images(made), made.table, made.prior, request, stated_noise=Stated(), accept_faults=accept_faults
    )


@pytest.fixture(scope="module")
def sound() -> Dome:
    return dome(1, views=24)


def test_the_record_is_accepted_and_its_files_are_beside_it(sound: Dome, tmp_path: Path) -> None:
    result = found(sound)
    path = tmp_path / "leds-test.yaml"
    write_outcome(path, Outcome(result.record, partial(draw_leds, result), result.files))
    record = read_record(path)
    assert record.is_accepted
    assert record.kind == "leds"
    assert {file.name for file in record.files} == {"leds-test.csv", "leds-test.h5"}


def test_the_new_table_can_be_a_rigs_dome(sound: Dome, tmp_path: Path) -> None:
    path = tmp_path / "dome.csv"
    path.write_bytes(found(sound).files["leds-test.csv"])
    table = read_led_table(path)
    assert (table.ids == sound.table.ids).all()
    assert np.median(np.linalg.norm(table.positions_mm - sound.true_mm, axis=1)) < 0.12
    assert np.allclose(np.linalg.norm(table.normals, axis=1), 1)


def test_each_leds_covariance_is_kept(sound: Dome) -> None:
    with h5py.File(io.BytesIO(found(sound).files["leds-test.h5"])) as file:
        covariance = file["centre_covariance"][:]
        assert covariance.shape == (48, 3, 3)
        assert (np.linalg.eigvalsh(covariance) > 0).all()
        assert file["normal_covariance"].shape == (48, 2, 2)
        assert file["found"][:].all()


def test_swapped_leds_have_each_others_place_in_the_new_table(sound: Dome) -> None:
    result = found(replace(sound, seen=rewired(sound, {4: 29, 29: 4})), accept_faults=True)
    assert result.record.is_accepted
    assert "leds-test.csv" in result.files
    assert np.linalg.norm(result.new_table.positions_mm[4] - sound.true_mm[29]) < 0.5
    assert result.new_table.boards[4] == 4
    assert any("swapped" in remark for remark in result.record.remarks)


@pytest.mark.parametrize(
    ("seen", "kind", "leds"),
    [
        (lambda dome: rewired(dome, {4: 29, 29: 4}), "swapped", (4, 29)),
        (lambda dome: dome.seen.only(np.flatnonzero(dome.seen.led != 17)), "dead", (17,)),
    ],
)
def test_a_fault_of_leds_is_kept_in_a_record_that_is_not_accepted_and_has_no_table(
    sound: Dome, tmp_path: Path, seen: Callable[[Dome], LedSightings], kind: str, leds: tuple[int, ...]
) -> None:
    wrong = replace(sound, seen=seen(sound))
    result = found(wrong)
    assert [limit.what for limit in result.record.limits if not limit.is_met] == (
        ["faults of LEDs and wires"] if kind == "swapped" else ["LEDs not found", "faults of LEDs and wires"]
    )
    assert set(result.files) == {"leds-test.h5"}
    path = tmp_path / "leds-test.yaml"
    write_outcome(path, Outcome(result.record, partial(draw_leds, result), result.files))
    kept = [fault for fault in read_record(path).faults if fault.is_wrong]
    assert [(fault.kind, tuple(sorted(fault.leds))) for fault in kept] == [(kind, leds)]


def test_a_board_that_moved_against_its_table_is_named(sound: Dome) -> None:
    moved_mm = sound.table.positions_mm.copy()
    moved_mm[18:24] += [0.0, 0.0, 14.0]
    result = found(replace(sound, table=replace(sound.table, positions_mm=moved_mm)))
    assert any(remark.startswith("board 3 stands 1") for remark in result.record.remarks)
    assert result.record.is_accepted, "a board that was mounted anew is what a calibration is for"


def test_too_many_dead_leds_are_not_accepted(sound: Dome) -> None:
    dark = sound.seen.only(np.flatnonzero(sound.seen.led > 2))
    record = found(replace(sound, seen=dark)).record
    assert not record.is_accepted
    assert [limit.what for limit in record.limits if not limit.is_met] == [
        "LEDs not found",
        "faults of LEDs and wires",
    ]


def test_a_lens_of_another_focus_is_named_though_its_record_says_nothing() -> None:
    made = dome(2, views=24, noise=Noise(records=0.0))
    lens = replace(made.prior.lens, fx=made.prior.lens.fx * 1.003, fy=made.prior.lens.fy * 1.003)
    assert isinstance(lens, Intrinsics)
    record = found(replace(made, prior=replace(made.prior, lens=lens))).record
    assert not record.is_accepted
    assert any("the record was made at another focus" in remark for remark in record.remarks)


def test_without_any_led_near_the_table_nothing_is_claimed(sound: Dome) -> None:
    away = replace(sound.table, positions_mm=sound.table.positions_mm + 5000.0)
    with pytest.raises(InputError, match="none was found near its place"):
        found(replace(sound, table=away))
