"""How bright white will be, by the cell's own lamps, lens and sensor, and that it is never guessed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
from cells import CellFolder
from places import REPO

from coupole.plan.led_table import LedTable
from coupole.preflight.exposure_scale import exposed_white, exposure_scale
from coupole.preflight.job import Job, read_job

ABOVE_MM = 1000.0


def job_with(white_response: dict[str, float] | None, **plan: Any) -> Job:
    """The demo, uncalibrated, under one LED of 1800 lm, straight above the support's centre."""
    from coupole.plan.rig import Rig

    job = read_job(REPO / "configs/plans/demo.yaml")
    rig = Rig.model_validate({**job.cell.rig.model_dump(), "white_response": white_response})
    pose = rig.support.base_from_support.matrix()
    centre, up = pose[:3, 3], pose[:3, 2]
    one = LedTable(np.array([0]), np.array([0]), (centre + ABOVE_MM * up)[None], -up[None], np.array([1800.0]))
    cell = replace(job.cell, rig=rig, leds=one)
    return replace(job, cell=cell, plan=job.plan.model_copy(update=plan), calibrations=None)


def test_white_under_an_led_of_the_dome_is_as_bright_as_its_illuminance() -> None:
    """1800 lm are 573 cd on axis: 573 lux at a metre; at 100 DN per lux second 8 ms give 458 DN of 4031."""
    job = job_with({"dn_per_lux_s": 100.0, "f_number": 8.0})
    scale = exposure_scale(job)
    assert scale is not None
    (white,) = exposed_white(job, scale)
    assert white.brightest == pytest.approx(1800.0 / np.pi * 100.0 * 0.008 / 4031, rel=1e-4)
    assert white.verdict() == "well exposed"


def test_the_cameras_gain_counts() -> None:
    louder, plain = (job_with({"dn_per_lux_s": 10.0, "f_number": 8.0}, gain_db=gain) for gain in (20.0, 0.0))
    found = [exposed_white(job, scale)[0].brightest for job in (louder, plain) if (scale := exposure_scale(job))]
    assert found[0] == pytest.approx(10.0 * found[1])


@pytest.mark.parametrize(
    "told", [None, {"dn_per_lux_s": 100.0, "f_number": 5.6}], ids=["no-figure", "another-aperture"]
)
def test_without_a_figure_for_this_lens_nothing_is_known(told: dict[str, float] | None) -> None:
    assert exposure_scale(job_with(told)) is None


def test_check_says_that_it_does_not_know_and_how_to_make_it_known(cell: CellFolder) -> None:
    ended = cells.here("check", cell.plan, "--no-paths")
    assert "not known; set `white_response` in the rig" in " ".join(ended.err.split())


@pytest.mark.parametrize(
    ("dn_per_lux_s", "words"),
    [(1.0, "8000 us: under-exposed: white reaches 0% "), (40_000.0, "8000 us: over-exposed: white reaches ")],
)
def test_check_warns_of_exposures_that_cannot_be_right(cell: CellFolder, dn_per_lux_s: float, words: str) -> None:
    cell.rig_data["white_response"] = {"dn_per_lux_s": dn_per_lux_s, "f_number": 8.0}
    cell.write()
    ended = cells.here("check", cell.plan, "--no-paths", "--json")
    assert ended.code == 0
    assert ended.document["exposure_scale"] == "the rig's white_response"
    assert any(warning.startswith(words) for warning in ended.document["warnings"])


def test_a_damaged_table_of_led_powers_is_refused_with_its_name(tmp_path: Path) -> None:
    from coupole.errors import InputError
    from coupole.intake.input_files import InputFiles
    from coupole.preflight import exposure_scale as module

    class Named:
        name = "power.csv"

    class Found:
        files = (Named,)

    (tmp_path / "power.csv").write_text("id,board_c,power_G\n0,24,bright\n")
    with pytest.raises(InputError, match=r"power\.csv: expected the table of LED powers"):
        module._power(tmp_path / "power.yaml", Found(), InputFiles(), np.array([0]))  # type: ignore[arg-type]
