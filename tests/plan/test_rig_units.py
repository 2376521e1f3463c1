"""Values of a rig in another unit than expected: impossible ones are refused at their place, improbable ones are
warned of, and those of real cells are neither."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cells
import pytest
from cells import CellFolder
from places import REPO
from ruamel.yaml import YAML

from coupole.errors import InputError
from coupole.plan.cell import read_cell
from coupole.plan.shipped_files import shipped_folder, shipped_names

BOX_MM = ([-740, -740, -50], [740, 740, 20])
ASKS = re.compile(r"rig\.yaml:\d+:\d+: ([\w.\[\]]+): (.*)")


def rig(folder: Path, section: str, value: Any) -> CellFolder:
    """A cell whose rig has this value, or whose section has these keys."""
    cell = CellFolder(folder, write_now=False)
    old = cell.rig_data.get(section)
    cell.rig_data[section] = {**old, **value} if isinstance(old, dict) else value
    cell.write()
    return cell


def box(scale: float) -> dict[str, Any]:
    low, high = ([scale * x for x in corner] for corner in BOX_MM)
    return {"kind": "box", "name": "support", "min_mm": low, "max_mm": high}


def ball(radius_mm: float) -> dict[str, Any]:
    return {"kind": "sphere", "name": "lamp", "center_mm": [0, 0, 300], "radius_mm": radius_mm}


def body(radius_mm: float, *, scale: float = 1.0) -> dict[str, Any]:
    ends = {"from_mm": [0, 0, 20 * scale], "to_mm": [0, 0, 100 * scale]}
    return {"name": "camera", **ends, "radius_mm": radius_mm}


def support_at(scale: float) -> dict[str, Any]:
    return {"base_from_support": {"translation_mm": [200 * scale, 0, 1450 * scale], "abc_deg": [0, 0, 180]}}


def arm(lengths: float = 1.0, radii: float = 1.0) -> dict[str, Any]:
    """The shipped KR10, with these scales."""
    found: dict[str, Any] = YAML(typ="safe", pure=True).load(REPO / "configs/robots/kr10_r1100_sixx.yaml")
    for joint in found["joints"]:
        joint["origin_mm"] = [lengths * x for x in joint["origin_mm"]]
    for link in found["links"]:
        for capsule in link["capsules"]:
            capsule["radius_mm"] *= radii
    return found


@pytest.mark.parametrize(
    ("section", "value", "key", "says"),
    [
        ("clearances", {"object_mm": 0.05}, "clearances.object_mm", "expected 0 or at least 0.5 mm, found 0.05"),
        ("clearances", {"dome_mm": 0.02}, "clearances.dome_mm", "is it in mm?"),
        ("tool", [body(0.06)], "tool[0].radius_mm", "expected at least 0.5 mm, found 0.06; is it in mm?"),
        ("tool", [body(60), body(60, scale=1e-3)], "tool[1].to_mm", "at least 1 mm, found 0.1; is it in mm?"),
        ("support", support_at(1e-3), "support.base_from_support", "at least 3 mm, found 1.46; is it in mm?"),
        ("arm", arm(lengths=1e-3), "arm", "at least 20 mm, found "),
        ("arm", arm(radii=1e-3), "arm", "at least 0.5 mm, found "),
        ("led_limits", {"board": {"limit_c": 343.15}}, "led_limits.board.limit_c", "at most 150 C, found 343"),
        ("keep_out", [ball(60), box(1e-3)], "keep_out[1]", "at least 1 mm3, found 0.153; is it in mm?"),
        ("keep_out", [ball(0.06)], "keep_out[0]", "at least 1 mm3, found 0.000905; is it in mm?"),
        ("lens", {"focal_length_mm": 0.035}, "lens.focal_length_mm", "at least 0.5 mm, found 0.035; is it in mm?"),
        ("sensor", {"pixel_pitch_um": 0.00345}, "sensor.pixel_pitch_um", "is it in um?"),
        ("support", {"diameter_mm": 1.48}, "support.diameter_mm", "at least 3 mm, found 1.48; is it in mm?"),
        ("dome", {"panel_lux": 0.18}, "dome.panel_lux", "expected 0 or at least 1 lux, found 0.18; is it in lux?"),
    ],
)
def test_what_no_cell_can_have_is_refused_at_its_place(
    tmp_path: Path, section: str, value: Any, key: str, says: str
) -> None:
    with pytest.raises(InputError) as refused:
        read_cell(rig(tmp_path, section, value).rig)
    (problem,) = [one for one in refused.value.problems if "stand-in" not in one.message]
    assert (problem.key, problem.line > 0, problem.column > 0) == (key, True, True)
    assert says in problem.message


def test_a_dome_in_metres_is_refused(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path)
    head, *rows = [line for line in read_cell(cell.rig).leds_path.read_text().splitlines() if line[0] != "#"]
    fields = [row.split(",") for row in rows]
    in_m = [[*row[:2], *(str(float(x) / 1e3) for x in row[2:5]), *row[5:]] for row in fields]
    (tmp_path / "leds.csv").write_text("\n".join([head, *map(",".join, in_m)]) + "\n")
    with pytest.raises(InputError, match=r"dome\.leds: expected LEDs at least 5 mm apart, found .*is it in mm\?"):
        read_cell(rig(tmp_path, "dome", {"leds": "leds.csv"}).rig)


@pytest.mark.parametrize(
    ("section", "value", "key", "says"),
    [
        ("clearances", {"object_mm": 1}, "clearances.object_mm", "1 mm is unusually little; is it in mm?"),
        ("tool", [body(60, scale=0.03)], "tool[0].to_mm", "3 mm is unusually little; is it in mm?"),
        ("keep_out", [{**ball(60), "center_mm": [0, 0, 0.3]}], "keep_out[0].center_mm", "0.3 mm is unusually"),
        ("led_limits", {"board": {"led_power_w": 0.015}}, "led_limits.board.led_power_w", "is it in W?"),
        ("led_limits", {"board": {"time_constant_s": 4}}, "led_limits.board.time_constant_s", "is it in s?"),
        ("tool", [body(3)], "tool[0].radius_mm", "3 mm is unusually little; is it in mm?"),
        ("keep_out", [box(2e-3)], "keep_out[0]", "1.23 mm3 is unusually little; is it in mm?"),
        ("flange_from_camera", {"translation_mm": [0, 0, 0.12]}, "flange_from_camera.translation_mm", "in mm?"),
        ("led_limits", {"rise_us": 1}, "led_limits.rise_us", "1 us is unusually little; is it in us?"),
        ("motion", {"acceleration_deg_s2": 5.24}, "motion.acceleration_deg_s2", "is it in deg/s2?"),
        ("motion", {"jerk_deg_s3": 52.4}, "motion.jerk_deg_s3", "is it in deg/s3?"),
        ("dome", {"panel_lux": 4}, "dome.panel_lux", "4 lux is unusually little; is it in lux?"),
    ],
)
def test_what_is_improbable_is_warned_of_with_its_place(
    tmp_path: Path, section: str, value: Any, key: str, says: str
) -> None:
    (remark,) = read_cell(rig(tmp_path, section, value).rig).remarks
    found = ASKS.search(remark)
    assert found is not None, remark
    assert found.group(1) == key
    assert says in found.group(2)


def test_preflight_says_so(tmp_path: Path) -> None:
    cell = rig(tmp_path, "led_limits", {"rise_us": 1})
    checked = cells.here("check", cell.plan, "--no-paths", "--json")
    assert checked.code == 0, checked
    assert any("led_limits.rise_us: 1 us is unusually little" in one for one in checked.document["warnings"])


def test_no_shipped_rig_is_doubted() -> None:
    for name in shipped_names("rigs"):
        remarks = read_cell(shipped_folder() / "rigs" / f"{name}.yaml").remarks
        assert not [one for one in remarks if "unusually" in one], name


def test_zero_is_none_and_thin_things_are_possible(tmp_path: Path) -> None:
    for section, value in (
        ("clearances", {"object_mm": 0, "support_mm": 0, "dome_mm": 0}),
        ("dome", {"panel_lux": 0}),
        ("led_limits", {"rise_us": 0}),
        ("flange_from_camera", {"translation_mm": [0, 0, 0]}),
        ("keep_out", [{"kind": "box", "name": "sheet", "min_mm": [0, 0, 0], "max_mm": [900, 900, 0.01]}]),
    ):
        cell = read_cell(rig(tmp_path, section, value).rig)
        assert not [one for one in cell.remarks if "unusually" in one], json.dumps(value)
