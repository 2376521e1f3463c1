"""Wrong plans and rigs: each mistake gives one problem, at its place, in an operator's words.

In the tables § marks where the problem must stand; it is taken out before the file is written.
"""
# ruff: noqa: E501  (one line for each mistake, however long)

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coupole.errors import InputError, Problem
from coupole.plan.base_model import Model
from coupole.plan.plan import Plan
from coupole.plan.rig import Rig
from coupole.plan.yamlfile import read_document

PLAN = """\
schema_version: 1
name: bunny-demo
rig: ../rigs/sim.yaml
object: {id: demo-relief, mesh: relief.ply, dose_budget_lux_h: 50}
calibrations: none
views:
  - {kind: look_at, name: top, target_mm: [0, 0, 60], distance_mm: 335, azimuth_deg: 0, elevation_deg: 80}
  - kind: grid
    name: ring
    target_mm: [0, 0, 60]
    distance_mm: 335
    azimuths_deg: [0, 120, 240]
    elevations_deg: [45]
  - {kind: joints, name: park, joints_deg: [0, -90, 90, 0, 90, 0]}
lights: {kind: all}
repeats: 1
exposure: {kind: fixed, exposure_us: 8000}
darks_per_view: 2
trigger: hardware
reshoot_limit: 3
"""

WRONG_PLANS = [
    # text of the plan, what stands there instead, key path, phrase of the message
    ("schema_version: 1\n", "§", "schema_version", "missing key `schema_version`: `1`"),
    ("schema_version: 1", "schema_version: §2", "schema_version", "expected `1`, found 2"),
    ("name: bunny-demo", "name: §bunny demo", "name", "found text `bunny demo`"),
    ("name: bunny-demo", "name: §7", "name", "expected text of the form"),
    ("name: bunny-demo", "§name:", "name", "found nothing"),
    ("rig: ../rigs/sim.yaml", "rig: §[a]", "rig", "expected a path, found a list of 1"),
    ("{id: demo-relief, ", "§{", "object.id", "missing key `id`"),
    ("mesh: relief.ply", "§mehs: relief.ply", "object.mehs", "unknown key `mehs`; did you mean `mesh`?"),
    ("dose_budget_lux_h: 50", "dose_budget_lux_h: §0", "object.dose_budget_lux_h", "a number above 0 and at most 1000000000, found 0"),
    ("lux_h: 50", "lux_h: §-.inf", "object.dose_budget_lux_h", "found -inf, no finite number"),
    ("lux_h: 50", "lux_h: 50, mesh_unit: §cm", "object.mesh_unit", "expected `mm` or `m` or `um`"),
    ("{id: demo-relief, mesh: relief.ply, dose_budget_lux_h: 50}", "§relief", "object", "expected a mapping"),
    ("calibrations: none", "calibrations: §5", "calibrations", "expected `none` or a list of paths, found 5"),
    ("calibrations: none", "calibrations: §non", "calibrations", "did you mean `none`?"),
    ("calibrations: none", "calibrations: [a.json, §5]", "calibrations[1]", "expected a path, found 5"),
    ("kind: look_at", "kind: §lookat", "views[0].kind", "one of `look_at`, `grid`, `joints`, found text `lookat`"),
    ("kind: look_at", "§knd: look_at", "views[0].knd", "did you mean `kind`"),
    ("{kind: look_at, ", "§{", "views[0].kind", "missing key `kind`: one of `look_at`, `grid`, `joints`"),
    ("kind: look_at", "kind: §[look_at]", "views[0].kind", "found a list of 1"),
    ("kind: look_at", "§kind: ", "views[0].kind", "found nothing"),
    ("[0, 0, 60], distance_mm: 335,", "§[0, 0], distance_mm: 335,", "views[0].target_mm", "3 numbers, found 2"),
    ("[0, 0, 60], dist", "§[0, 0, 6, 0], dist", "views[0].target_mm", "a list of 3 numbers, found 4"),
    ("[0, 0, 60], dist", "[0, §up, 6], dist", "views[0].target_mm[1]", "expected a number from -20000 to 20000, found text `up`"),
    ("[0, 0, 60], dist", "§12, dist", "views[0].target_mm", "expected a list of 3 numbers, found 12"),
    ("distance_mm: 335, ", 'distance_mm: §"335", ', "views[0].distance_mm", "above 0 and at most 3000, found text"),
    ("distance_mm: 335, ", "distance_mm: §3001, ", "views[0].distance_mm", "at most 3000, found 3001"),
    ("distance_mm: 335, ", "§distance: 335, ", "views[0].distance", "did you mean `distance_mm`?"),
    ("    distance_mm: 335\n", "    §distanze_mm: 335\n", "views[1].distanze_mm", "did you mean `distance_mm`?"),
    ("azimuth_deg: 0", "azimuth_deg: §yes", "views[0].azimuth_deg", "from -360 to 360, found text `yes`"),
    ("azimuth_deg: 0", "azimuth_deg: §.nan", "views[0].azimuth_deg", "found nan, no finite number"),
    ("elevation_deg: 80", "elevation_deg: §91", "views[0].elevation_deg", "a number from -90 to 90, found 91"),
    ("elevation_deg: 80", "elevation_deg: 80, §colour: red", "views[0].colour", "unknown key `colour`; valid keys: "),
    ("- kind: grid\n    name: ring", "- §kind: grid", "views[1].name", "missing key `name`: text"),
    ("[0, 120, 240]", "§[]", "views[1].azimuths_deg", "a list of numbers (at least 1), found 0"),
    ("[0, 120, 240]", "[0, §361, 240]", "views[1].azimuths_deg[1]", "from -360 to 360, found 361"),
    ("[0, -90, 90, 0, 90, 0]", "§[0, -90, 90]", "views[2].joints_deg", "a list of 6 numbers, found 3"),
    ("[0, -90, 90, 0, 90, 0]", "[0, -90, 90, 0, 90, §true]", "views[2].joints_deg[5]", "found true"),
    ("{kind: all}", "{kind: §al}", "lights.kind", "did you mean `all`?"),
    ("{kind: all}", "§all", "lights", "expected a mapping whose `kind` is one of `all`, `ids`"),
    ("{kind: all}", "{kind: all, §ids: [1]}", "lights.ids", "unknown key `ids`; valid keys: kind"),
    ("{kind: all}", "§{kind: every}", "lights.every", "missing key `every`: a whole number from 1 to 65535"),
    ("{kind: all}", "{kind: every, every: §0}", "lights.every", "a whole number from 1 to 65535, found 0"),
    ("{kind: all}", "{kind: ids, ids: §[1, 2, 1]}", "lights.ids", "these are given more than once: [1]"),
    ("{kind: all}", "{kind: ids, ids: [1, §2.5]}", "lights.ids[1]", "a whole number from 0 to 65534, found 2.5"),
    ("{kind: all}", "{kind: panels, panels: [§5]}", "lights.panels[0]", "from 1 to 4, found 5"),
    ("repeats: 1", "repeats: §0", "repeats", "a whole number from 1 to 1000, found 0"),
    ("repeats: 1", "repeats: §'1'", "repeats", "found text `1`"),
    ("exposure: {kind", "§exposur: {kind", "exposur", "did you mean `exposure`? valid keys: schema_version, name"),
    ("exposure: {kind", "§Exposure: {kind", "Exposure", "did you mean `exposure`?"),
    ("exposure_us: 8000", "exposure_us: §1.5", "exposure.exposure_us", "from 10 to 2000000, found 1.5"),
    ("exposure_us: 8000", "exposure_us: §9", "exposure.exposure_us", "from 10 to 2000000, found 9"),
    ("exposure_us: 8000", "§exposures_us: [8000]", "exposure.exposures_us", "did you mean `exposure_us`?"),
    ("{kind: fixed, exposure_us: 8000}", "{kind: bracket, exposures_us: §[9000, 8000]}", "exposure.exposures_us", "incr"),
    ("{kind: fixed, exposure_us: 8000}", "§{kind: auto, longest_us: 900, shortest_us: 500}", "exposure", "at least twice `shortest_us` (500); found 900"),
    ("{kind: fixed, exposure_us: 8000}", "§{kind: auto}", "exposure.longest_us", "missing key `longest_us`"),
    ("{kind: fixed, exposure_us: 8000}", "{kind: auto, longest_us: 9000, snr: §0}", "exposure.snr", "found 0"),
    ("{kind: fixed, exposure_us: 8000}", "{kind: auto, longest_us: 9000, most_exposures: §1}", "exposure.most_exposures", "from 2 to 4, found 1"),
    ("{kind: fixed, exposure_us: 8000}", "{kind: bracket, exposures_us: §[90]}", "exposure.exposures_us", "(at least 2 and at most 16), found 1"),
    ("trigger: hardware", "trigger: §hardwar", "trigger", "did you mean `hardware`?"),
    ("reshoot_limit: 3", "reshoot_limit: §yes", "reshoot_limit", "a whole number from 0 to 20, found text `yes`"),
]  # fmt: skip

RIG = """\
schema_version: 1
name: cell
ledbox: {driver: "drivers.ledbox:LedBox", settings: {port: COM3}}
camera: {driver: "sim.devices.memory_camera:MemoryCamera"}
robot: {driver: "drivers.kuka.rsi:KukaRsi"}
sensor: {width_px: 512, height_px: 384, pixel_pitch_um: 3.2}
lens: {focal_length_mm: 50, f_number: 8, focus_distance_mm: 335}
flange_from_camera: {translation_mm: [0, 0, 100]}
tool: [{name: camera, from_mm: [0, 0, 20], to_mm: [0, 0, 100], radius_mm: 60}]
dome: {leds: ../domes/coupole.csv}
support: {base_from_support: {translation_mm: [200, 0, 1450], abc_deg: [0, 0, 180]}}
keep_out:
  - {kind: sphere, name: object, center_mm: [0, 0, 60], radius_mm: 150}
led_limits: {on_us: [1000, 2000000]}
storage: {folder: ../../runs}
"""

WRONG_RIGS = [
    ('"drivers.ledbox:LedBox"', "§drivers.ledbox.driver", "ledbox.driver", "found text `drivers.ledbox.driver`"),
    ('driver: "drivers.ledbox:LedBox"', "§drivr: a:B", "ledbox.drivr", "did you mean `driver`?"),
    ("camera: {", "§camra: {", "camra", "did you mean `camera`?"),
    ("settings: {port: COM3}", "settings: §COM3", "ledbox.settings", "expected a mapping, found text `COM3`"),
    ("width_px: 512", 'width_px: §"512"', "sensor.width_px", "a whole number from 8 to 65536, found text `512`"),
    ("3.2}", "3.2, bayer_pattern: §RGBG}", "sensor.bayer_pattern", "`GBRG` or `GRBG` or `RGGB`"),
    ("f_number: 8", "f_number: §-8", "lens.f_number", "a number above 0 and at most 1000, found -8"),
    ("{translation_mm: [0, 0, 100]}", "{translation_mm: §[0, 0]}", "flange_from_camera.translation_mm", "found 2"),
    ("leds: ../domes/coupole.csv", "§led: a.csv", "dome.led", "did you mean `leds`?"),
    ("abc_deg: [0, 0, 180]", "abc_deg: [0, 0, §pi]", "support.base_from_support.abc_deg[2]", "found text `pi`"),
    ("kind: sphere", "kind: §spere", "keep_out[0].kind", "did you mean `sphere`?"),
    (", radius_mm: 150", "", "keep_out[0].radius_mm", "missing key `radius_mm`: a number above 0"),
    ("on_us: [1000, 2000000]", "on_us: §[1000]", "led_limits.on_us", "a list of 2 whole numbers, found 1"),
    ("{folder: ../../runs}", "{folder: §5}", "storage.folder", "expected a path, found 5"),
]  # fmt: skip


def problems_of(folder: Path, text: str, model: type[Model]) -> list[Problem]:
    path = folder / "wrong.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_document(path).validate(model)
    return list(refused.value.problems)


def assert_one_problem(problems: list[Problem], marked: str, key: str, phrase: str) -> None:
    before, mark, _ = marked.partition("§")
    (problem,) = problems
    assert problem.key == key
    assert phrase in problem.message
    if mark:
        line_start = before.rfind("\n") + 1
        assert (problem.line, problem.column) == (before.count("\n") + 1, len(before) - line_start + 1)


def changed(good: str, old: str, new: str) -> str:
    assert old in good
    return good.replace(old, new, 1)


def test_the_good_plan_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "good.yaml"
    path.write_text(PLAN, encoding="utf-8")
    assert read_document(path).validate(Plan).rig == Path("../rigs/sim.yaml")


def test_the_good_rig_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "good.yaml"
    path.write_text(RIG, encoding="utf-8")
    assert read_document(path).validate(Rig).dome.leds == Path("../domes/coupole.csv")


@pytest.mark.parametrize(("old", "new", "key", "phrase"), WRONG_PLANS)
def test_one_mistake_in_a_plan_gives_one_problem_at_its_place(
    tmp_path: Path, old: str, new: str, key: str, phrase: str
) -> None:
    marked = changed(PLAN, old, new)
    assert_one_problem(problems_of(tmp_path, marked.replace("§", ""), Plan), marked, key, phrase)


@pytest.mark.parametrize(("old", "new", "key", "phrase"), WRONG_RIGS)
def test_one_mistake_in_a_rig_gives_one_problem_at_its_place(
    tmp_path: Path, old: str, new: str, key: str, phrase: str
) -> None:
    marked = changed(RIG, old, new)
    assert_one_problem(problems_of(tmp_path, marked.replace("§", ""), Rig), marked, key, phrase)


def test_all_mistakes_of_a_plan_are_reported_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = PLAN
    for old, new in [
        ("trigger: hardware", "trigger: hard"),
        ("name: bunny-demo", "name: a b"),
        ("exposure:", "exposur:"),
        ("[0, 0, 60]", "[0, 0]"),
        ("kind: grid", "kind: gird"),
        ("joints_deg: [0", "joints_deg: ['0'"),
        ("{kind: all}", "{kind: all, n: 1}"),
    ]:
        text = changed(text, old, new)
    assert [problem.key for problem in problems_of(tmp_path, text, Plan)] == [
        "name",
        "views[0].target_mm",
        "views[1].kind",
        "views[2].joints_deg[0]",
        "lights.n",
        "exposur",
        "trigger",
    ]


def test_a_plan_that_shoots_nothing_is_refused(tmp_path: Path) -> None:
    text = changed(changed(PLAN, "{kind: all}", "{kind: none}"), "darks_per_view: 2", "darks_per_view: 0")
    (problem,) = problems_of(tmp_path, text, Plan)
    assert "takes no frame" in problem.message


@given(
    st.lists(
        st.tuples(
            st.integers(0, len(PLAN)),
            st.integers(0, 12),
            st.sampled_from(
                ["", " ", "\n", "x", "[", "{", ": ", "- ", "'", "1", "kind", "null", ".nan", "&a", "*a"]
            ),
        ),
        min_size=1,
        max_size=3,
    )
)
def test_a_mutated_plan_is_accepted_or_refused_with_problems(
    tmp_path_factory: pytest.TempPathFactory, edits: list[tuple[int, int, str]]
) -> None:
    text = PLAN
    for start, length, inserted in edits:
        text = text[:start] + inserted + text[start + length :]
    path = tmp_path_factory.getbasetemp() / "mutated.yaml"
    path.write_text(text, encoding="utf-8")
    try:
        read_document(path).validate(Plan)
    except InputError as error:
        unplaced = [problem for problem in error.problems if not problem.line]
    else:
        unplaced = []
    assert not unplaced or not text.strip()
