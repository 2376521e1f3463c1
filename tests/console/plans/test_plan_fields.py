"""A plan's text and the form beside it: what is filled in is what is written, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from cells import REPO, CellFolder
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML

from coupole.console.plans.plan_fields import PlanFields, fields_of, text_with
from coupole.console.plans.plan_files import PlanFiles
from coupole.console.plans.retaking import retaking_plan
from coupole.errors import InputError
from coupole.plan.schedule import expand_view
from coupole.preflight.job import read_job
from coupole.storage.run import Run

PATH = Path("vase.yaml")
TEXT = """\
# Of the workshop's vase.
schema_version: 1
name: vase
rig: rig.yaml   # ours
object: {id: vase}
views:
  - {kind: look_at, name: top, target_mm: [0, 0, 30], distance_mm: 335, azimuth_deg: -90, elevation_deg: 80}
lights: {kind: cone, azimuth_deg: 0, elevation_deg: 90, half_angle_deg: 30}
exposure: {kind: fixed, exposure_us: 8000}   # by meter
gain_db: 3
"""

FIELDS = st.builds(
    PlanFields,
    object_id=st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,12}", fullmatch=True),
    mesh=st.sampled_from(["", "vase.ply", "../objects/a b.stl"]),
    mesh_unit=st.sampled_from(["mm", "m", "um"]),
    budget_lux_h=st.none() | st.floats(0.01, 1e6),
    distance_mm=st.integers(100, 900),
    elevations_deg=st.lists(st.integers(-10, 89), min_size=1, max_size=4, unique=True).map(tuple),
    azimuths=st.integers(1, 40),
    exposures_us=st.lists(st.integers(20, 100_000), min_size=1, max_size=3, unique=True).map(sorted).map(tuple),
    every_led=st.integers(1, 50),
    darks_per_view=st.integers(0, 20),
)


@given(FIELDS)
def test_what_is_filled_in_is_what_is_written(fields: PlanFields) -> None:
    text = text_with(PATH, TEXT, fields, (1.5, -2.0, 30.0))
    assert fields_of(PATH, text) == fields
    plain = YAML(typ="safe", pure=True).load(text)
    assert plain["views"][0]["target_mm"] == [1.5, -2.0, 30.0]
    assert (plain["name"], plain["rig"], plain["gain_db"]) == ("vase", "rig.yaml", 3)
    assert "# Of the workshop's vase." in text
    assert "# ours" in text
    assert text_with(PATH, text, fields) == text


def test_what_the_form_does_not_know_stays_as_it_is() -> None:
    fields = fields_of(PATH, TEXT)
    assert fields.own_views
    assert fields.own_lights
    text = text_with(PATH, TEXT, replace(fields, budget_lux_h=5.0))
    plain, before = YAML(typ="safe", pure=True).load(text), YAML(typ="safe", pure=True).load(TEXT)
    assert plain.pop("object") == {"id": "vase", "dose_budget_lux_h": 5.0}
    before.pop("object")
    assert plain == before


@pytest.mark.parametrize(
    "text",
    [
        "object: 5\n",
        "views: 5\n",
        "views: [{target_mm: [a, b, c]}]\n",
        "darks_per_view: 99999999999999999999999\n",
        "object: {dose_budget_lux_h: .inf}\n",
    ],
)
def test_a_text_of_another_form_is_refused_in_words_or_left_as_it_is(text: str) -> None:
    fields = fields_of(PATH, text)
    wanted = replace(fields, object_id="vase", own_views=False, distance_mm=335, azimuths=2, elevations_deg=(60,))
    try:
        written, refusal = text_with(PATH, text, wanted), ""
    except InputError as error:
        written, refusal = "object: {id: vase}", str(error)
    assert not refusal or "cannot change" in refusal
    assert fields_of(PATH, written).object_id == "vase"
    with pytest.raises(InputError, match="1 to 360"):
        text_with(PATH, TEXT, replace(wanted, azimuths=10**9))


def test_a_plan_is_new_written_over_only_by_who_has_seen_it_and_stays_in_its_folder(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    plans = PlanFiles(tmp_path, cell.rig, tmp_path / "drawings")
    for template in ("round", "views", "darks"):
        name = plans.create(f"new-{template}", template)
        assert read_job(tmp_path / name).cell.document.path == cell.rig.resolve()
    assert {"new-round.yaml", "plan.yaml"} <= set(plans.names())
    assert "rig.yaml" not in plans.names()
    before = plans.read_text("new-round.yaml")
    plans.write("new-round.yaml", before + "# mine\n", before)
    with pytest.raises(InputError, match="another person has changed this plan"):
        plans.write("new-round.yaml", before, before)
    for name in ("../out.yaml", "/etc/passwd", "rig.json", ""):
        with pytest.raises(InputError):
            plans.read_text(name)
    with pytest.raises(InputError, match="exists already"):
        plans.create("plan", "views")
    with pytest.raises(InputError, match="letters"):
        plans.create("a/b", "views")


def test_a_view_is_taken_again_as_it_was(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    grid = {
        "kind": "grid",
        "name": "round",
        "target_mm": [0, 0, 30],
        "distance_mm": 335,
        "azimuths_deg": [-90, 30.5],
        "elevations_deg": [60],
        "roll_deg": 10,
    }
    cell.write(views=[grid], lights={"kind": "ids", "ids": [5, 700]})
    assert cell.acquire().code == 0
    run = Run(cell.run_folder)
    text = retaking_plan(run, "round-az30.5-el60", "again", cell.rig)
    (tmp_path / "again.yaml").write_text(text)
    job, whole = read_job(tmp_path / "again.yaml"), read_job(cell.plan)
    assert [view.name for view in job.schedule.views] == ["round-az30.5-el60"]
    (was,) = (one for one in expand_view(whole.plan.views[0]) if one.name == "round-az30.5-el60")
    (now,) = expand_view(job.plan.views[0])
    assert now.support_from_camera is not None
    assert now.support_from_camera == pytest.approx(was.support_from_camera)
    assert job.shape.corners_mm.shape == whole.shape.corners_mm.shape
    assert job.plan.lights == whole.plan.lights
    with pytest.raises(InputError, match="no view"):
        retaking_plan(run, "top", "again", REPO / "configs/rigs/sim.yaml")
