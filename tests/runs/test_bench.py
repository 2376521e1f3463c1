"""`coupole bench` on the simulated cell, over its wires: what is told, driven, moved by hand, and what ends it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import cells
import numpy as np
import pytest
from benches import ASKS, HERE, Bench, begun, bench, holding
from cells import CellFolder
from PIL import Image

from sim.devices.kuka_kinematics import flange_pose as flange_by_the_simulation
from sim.world.client import World

PARK_DEG = [60.0, -170.0, 150.0, 0.0, -70.0, 0.0]
HOME_DEG = [0.0, -170.0, 150.0, 0.0, -70.0, 0.0]
SUPPORT_MM, KEEP_OUT_MM = 1450.0, 20.0
"""The disk in the base frame of an arm that hangs above it, and the height that the rig keeps free."""
BUDGET_LUX_H = 0.14
TIP_MM, TIP_RADIUS_MM = 100.0, 60.0
"""Of the camera's capsule, in front of the flange."""


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> CellFolder:
    found = CellFolder(tmp_path_factory.mktemp("bench"), speed=1.0)
    found.rig_data["console"] = {"at_the_cell": [HERE]}
    found.rig_data["motion"]["park_joints_deg"] = PARK_DEG
    found.rig_data["ledbox"]["settings"]["watchdog_s"] = 2.0
    found.plan_data["object"]["dose_budget_lux_h"] = BUDGET_LUX_H
    found.join()
    return found


@pytest.fixture(scope="module")
def world(cell: CellFolder) -> Iterator[World]:
    """It outlives its controllers."""
    with cell.world() as found:
        yield found


@pytest.fixture(scope="module")
def asked(cell: CellFolder, world: World) -> Iterator[Bench]:
    with bench(cell.rig, "--object", cell.plan) as found:
        yield found


def tip_mm(joints_deg: Any) -> np.ndarray:
    """The camera's front in the base frame, by the simulation's own kinematics."""
    flange = flange_by_the_simulation(np.asarray(joints_deg))
    tip: np.ndarray = flange[:3, 3] + TIP_MM * flange[:3, 2]
    return tip


def joints_deg(world: World) -> np.ndarray:
    return np.array(world.ask("state")["joints_deg"])


def test_it_tells_each_device_and_the_arm(asked: Bench, world: World) -> None:
    state = asked.done("state")
    assert set(state["devices"]) == {"ledbox", "camera", "robot"}
    assert state["devices"]["ledbox"]["link"] == f"port {world.endpoints['ledbox']['port']}"
    assert state["devices"]["ledbox"]["temperature_c"] == pytest.approx(22.0, abs=2.0), "of a room"
    assert all(one["identity"]["simulated"] for one in state["devices"].values())
    assert state["object"] == "relief"
    arm = state["arm"]
    assert np.allclose(arm["joints_deg"], joints_deg(world), atol=1e-3)
    assert np.allclose(arm["links_mm"][7], flange_by_the_simulation(joints_deg(world))[:3, 3], atol=0.1)
    assert (arm["fault"], arm["moving"], arm["emergency_stop"]) == ("", False, None), "RSI does not tell"
    assert 0 <= arm["heard_s_ago"] < 1.0
    tested = asked.done("self_test", device="robot")
    assert tested["passed"]
    assert asked.done("state")["devices"]["robot"]["self_test"]["report"] == tested["report"]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (b"state", "Invalid JSON"),
        (b'{"version": 2, "command": "state"}', "version"),
        (b'{"version": 1, "command": "dance"}', "command"),
        (b'{"version": 1, "command": "plan_path", "to": {"joints_deg": [0, 0, 0]}}', "joints_deg"),
        (b'{"version": 1, "command": "drive", "path": "77"}', "expected one that `plan_path` has shown"),
        (b'{"version": 1, "command": "jog", "axis": "A1", "direction": 2, "from": "x"}', "direction"),
        (b'{"version": 1, "command": "jog", "axis": "A1", "direction": true, "from": "x"}', "direction"),
        (b'{"version": 1, "command": "jog", "axis": "A1", "direction": 1, "from": "x", "share": 1e-300}', "share"),
        (b'{"version": 1, "command": "plan_path", "to": {"joints_deg": [0, 0, 0, 0, 0, 1e3]}}', "A6 would be"),
    ],
)
def test_what_is_no_request_is_refused_with_what_was_expected(asked: Bench, line: bytes, says: str) -> None:
    assert says in asked.say(line)["error"]


def test_a_path_is_shown_before_it_is_driven(asked: Bench, cell: CellFolder, world: World) -> None:
    before_deg = joints_deg(world)
    path = asked.done("plan_path", to={"view": "top", "plan": str(cell.plan)})
    assert np.array_equal(before_deg, joints_deg(world)), "planning moves nothing"
    along_deg = np.array(path["joints_deg"])
    assert np.allclose(along_deg[0], before_deg, atol=1e-3)
    assert np.abs(np.diff(along_deg, axis=0)).max() <= 5.001
    flanges_mm = [flange_by_the_simulation(one)[:3, 3] for one in along_deg]
    assert np.allclose(np.array(path["links_mm"])[:, 7], flanges_mm, atol=0.1)
    begun_s = world.ask("state")["t_s"]
    asked.done("drive", path=path["path"])
    assert asked.ended_work() == {
        "kind": "drive", "state": "done", "path": path["path"], "to": "view top", "why": "",
    }  # fmt: skip
    assert np.allclose(joints_deg(world), path["waypoints_deg"][-1], atol=0.01)
    assert world.ask("state")["t_s"] - begun_s > 0.9 * (path["duration_s"] - 0.3)
    refused = asked.ask("drive", path=path["path"])
    assert "plan it again" in refused["error"], "the arm is elsewhere now"
    assert np.allclose(joints_deg(world), path["waypoints_deg"][-1], atol=0.01)
    asked.drive("park")
    assert np.allclose(joints_deg(world), PARK_DEG, atol=0.01)


def test_a_drive_is_stopped_on_its_way(asked: Bench, world: World) -> None:
    asked.drive("park")
    path = asked.done("plan_path", to="home")
    asked.done("drive", path=path["path"])
    assert "is under way" in asked.ask("drive", path=path["path"])["error"]
    cells.wait_until(lambda: abs(joints_deg(world)[0] - PARK_DEG[0]) > 3.0, "the arm under way")
    assert asked.done("stop")["trouble"] == []
    stopped_deg = joints_deg(world)
    assert asked.ended_work()["state"] == "stopped"
    assert abs(stopped_deg[0] - HOME_DEG[0]) > 3.0
    assert np.allclose(joints_deg(world), stopped_deg, atol=0.05)
    assert "plan it again" in asked.ask("drive", path=path["path"])["error"]
    asked.drive("home")


def test_by_hand_only_from_a_console_at_the_cell_and_slowly(asked: Bench, world: World) -> None:
    asked.drive("home")
    for elsewhere in ("10.0.0.7", "", "127.0.0.10"):
        request = {"axis": "A1", "direction": 1, "from": elsewhere}
        assert "only from a console at the cell" in asked.ask("jog", **request)["error"]
    assert np.allclose(joints_deg(world), HOME_DEG, atol=0.01)
    with holding(asked, "A1", 1):
        cells.wait_until(lambda: joints_deg(world)[0] > 1.0, "the arm under way")
        before, after = cells.wait_until(
            lambda: _half_a_second_of_one_hold(asked, world), "half a second of a hold"
        )
    turned = np.radians(after["joints_deg"][0] - before["joints_deg"][0])
    reach_mm = 25 + 560 + 515 + 80 + TIP_MM + TIP_RADIUS_MM
    speed_mm_s = turned * reach_mm / (after["t_s"] - before["t_s"])
    assert 50.0 < speed_mm_s < 105.0, "0.4 of 250 mm/s, were the arm stretched out"


def _half_a_second_of_one_hold(asked: Bench, world: World) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """The world before and after; None if the button was pressed anew in between."""
    hold, before = asked.done("state")["work"]["hold"], world.ask("state")
    time.sleep(0.5)
    after, work = world.ask("state"), asked.done("state")["work"]
    return (before, after) if (work["hold"], work["state"]) == (hold, "running") else None


def test_an_arm_whose_console_is_killed_stops_at_once(asked: Bench, world: World) -> None:
    asked.drive("home")
    with holding(asked, "A1", 1, share=1.0) as console:
        cells.wait_until(lambda: joints_deg(world)[0] > 1.0, "the arm under way")
        console.kill()
        console.wait()
        killed_s = world.ask("state")["t_s"]
        rested = cells.wait_until(lambda: not (s := world.ask("state"))["arm_moving"] and s, "the arm at rest")
    assert rested["t_s"] - killed_s < 1.0, "0.3 s, and its braking; the step would take seconds more"
    assert rested["joints_deg"][0] < 25.0
    work = asked.ended_work()
    assert (work["state"], work["why"]) == ("stopped", f"process {console.pid}, which asked for it, has ended")
    again = {"axis": "A1", "direction": 1, "from": HERE, "hold": work["hold"]}
    assert "is held by another process" in asked.ask("jog", **again)["error"]
    time.sleep(0.3)
    assert np.allclose(joints_deg(world), rested["joints_deg"], atol=0.01)


def test_towards_the_support_it_stops_before_it(asked: Bench, cell: CellFolder, world: World) -> None:
    asked.drive({"view": "top", "plan": str(cell.plan)})
    start_mm = tip_mm(joints_deg(world))
    with holding(asked, "z", 1, share=1.0) as console:
        console.wait(cells.PATIENCE_S)
        assert console.stdout is not None
        last = json.loads(console.stdout.read().splitlines()[-1])
    assert "must be kept" in last["ended"], last
    end_mm = tip_mm(joints_deg(world))
    assert end_mm[2] + TIP_RADIUS_MM <= SUPPORT_MM - KEEP_OUT_MM
    assert end_mm[2] > start_mm[2] + 50.0, "it went as far as it could"
    assert np.linalg.norm((end_mm - start_mm)[:2]) < 3.0, "straight down"
    asked.drive("home")


# -- pictures -------------------------------------------------------------------------------------------------


def raw(frame: dict[str, Any]) -> np.ndarray:
    found: np.ndarray = np.load(frame["raw"])
    return found


def dark(world: World) -> bool:
    state = world.ask("state")
    return not state["shining"] and not state["panels"]


def test_a_picture_has_its_figures_and_its_light_is_counted_and_off_again(
    asked: Bench, cell: CellFolder, world: World
) -> None:
    asked.drive({"view": "top", "plan": str(cell.plan)})
    before = asked.done("state")["dose"]
    given_s = world.ask("light")["leds_s"].get("500", 0.0)
    frame = asked.done("frame", lights=[500], exposure_us=8000, region=[21, 11, 89, 79], width_px=64)
    assert dark(world)
    on_s = world.ask("light")["leds_s"]["500"] - given_s
    assert 0.008 < on_s < 0.012
    dose = asked.done("state")["dose"]
    assert dose["bench_lux_h"] - before["bench_lux_h"] == pytest.approx(frame["dose_lux_h"])
    assert before["left_lux_h"] - dose["left_lux_h"] == pytest.approx(frame["dose_lux_h"])
    pixels = raw(frame)
    assert pixels.shape == (96, 128)
    blue = pixels[0::2, 1::2]
    assert frame["pattern"] == "GBRG"
    assert sum(frame["histograms"]["B"]) == blue.size
    assert frame["saturated"]["B"] == np.mean(blue >= frame["white_dn"])
    with Image.open(frame["picture"]) as picture:
        assert picture.size == (64, 48)
    region = pixels[10:90, 20:110].astype(float) - frame["black_dn"]  # whole Bayer cells
    gains = frame["region"]["white_point"]
    green = 0.5 * (region[0::2, 0::2].mean() + region[1::2, 1::2].mean())
    assert gains == pytest.approx([green / region[1::2, 0::2].mean(), 1.0, green / region[0::2, 1::2].mean()])
    assert frame["region"]["sharpness"] > 0.0
    unlit = asked.done("frame", exposure_us=8000, region=[21, 11, 89, 79])
    assert (unlit["dose_lux_h"], unlit["region"]["sharpness"]) == (0.0, 0.0), "noise is not sharp"
    assert unlit["region"]["white_point"] is None, "too dark to tell"


def test_several_lights_are_as_one_picture_under_all_of_them(asked: Bench) -> None:
    one, other = (raw(asked.done("frame", lights=[led], exposure_us=8000)).astype(int) for led in (500, 700))
    both = asked.done("frame", lights=[500, 700], exposure_us=8000)
    difference = raw(both) - (one + other - both["black_dn"])
    unsaturated = raw(both) < both["white_dn"]
    assert abs(difference[unsaturated].mean()) < 1.0, "DN; noise alone"
    assert raw(both).mean() > max(one.mean(), other.mean()) + 10.0


def test_a_panel_is_on_for_its_picture_only(asked: Bench, world: World) -> None:
    before_s = world.ask("light")["panels_s"]
    frame = asked.done("frame", panels=[2], exposure_us=20_000)
    after_s = world.ask("light")["panels_s"]
    assert dark(world)
    on_s = after_s["2"] - before_s.get("2", 0.0)
    assert on_s > 0.02
    assert frame["dose_lux_h"] == pytest.approx(180 * on_s / 3600, rel=0.3, abs=1e-3), (
        "from command to confirmation"
    )
    assert raw(frame).mean() > frame["black_dn"] + 5.0


def test_the_loupe_shows_the_last_picture_pixel_by_pixel_without_light(asked: Bench, world: World) -> None:
    frame = asked.done("frame", lights=[500], exposure_us=8000)
    light = world.ask("light")
    found = asked.done("loupe", region=[10, 8, 20, 12])
    assert world.ask("light") == light
    assert found["region"] == [10, 8, 20, 12]
    with Image.open(found["picture"]) as picture:
        shown = np.asarray(picture).astype(int)
    part = np.clip((raw(frame)[8:20, 10:30].astype(float) - frame["black_dn"]) / 4031, 0, 1)
    assert shown.shape == (12, 20, 3)
    for channel, at in ((1, np.s_[0::2, 0::2]), (2, np.s_[0::2, 1::2]), (0, np.s_[1::2, 0::2])):
        assert np.abs(shown[(*at, channel)] - 255 * part[at] ** (1 / 2.2)).max() <= 1.0, "GBRG"


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"lights": [5000]}, "LEDs of the dome"),
        ({"panels": [9]}, "from 1 to 4"),
        ({"lights": [500], "region": [120, 0, 20, 20]}, "within 128 x 96 px"),
        ({"lights": [500], "exposure_us": 30_000_000}, "exposure_us"),
        ({"lights": [500], "gains": [1, 0, 1]}, "gains"),
    ],
)
def test_a_picture_that_cannot_be_gives_no_light(
    asked: Bench, world: World, fields: dict[str, Any], says: str
) -> None:
    light = world.ask("light")
    assert says in asked.ask("frame", **{"exposure_us": 8000, **fields})["error"]
    assert world.ask("light") == light


def test_light_beyond_the_objects_budget_is_not_given(asked: Bench, world: World) -> None:
    a_little = asked.done("frame", lights=[500], exposure_us=8000)
    left_lux_h = asked.done("state")["dose"]["left_lux_h"]
    too_long_us = int(1.2 * left_lux_h / a_little["dose_lux_h"] * 8000)
    light = world.ask("light")
    refused = asked.ask("frame", lights=[500], exposure_us=too_long_us)
    assert refused["kind"] == "DoseBudgetReached", refused
    assert world.ask("light") == light
    assert asked.done("frame", lights=[500], exposure_us=8000)["dose_lux_h"] > 0.0


def test_it_meters_as_the_command_does_and_goes_on_after_it(asked: Bench, cell: CellFolder, world: World) -> None:
    asked.done("meter", plan=str(cell.plan))
    assert "metering" in asked.ask("frame", exposure_us=8000)["error"]
    work = asked.ended_work()
    assert work["state"] == "done", work["why"]
    assert work["exposure"]["kind"] in ("fixed", "bracket")
    assert all(value > 0 for value in work["noise"].values()), work["noise"]
    assert work["views"]["top"]["view"] == "top"
    assert dark(world)
    assert asked.done("frame", lights=[500], exposure_us=8000)["dose_lux_h"] > 0.0
    asked.drive("home")


def test_while_a_bench_holds_the_cell_no_other_does_and_the_command_asks_it(
    asked: Bench, cell: CellFolder, world: World
) -> None:
    refused = cells.here("bench", cell.rig, "--yes")
    assert refused.code == 2
    assert "another process has this cell's devices open" in refused.err
    driven = cells.here("arm", cell.rig, "park", "--json", typed="y\n")
    assert driven.code == 0, driven
    assert "park: 1." in driven.err
    assert np.allclose(joints_deg(world), PARK_DEG, atol=0.01)
    declined = cells.here("arm", cell.rig, "home", typed="n\n")
    assert declined.code == 130
    assert np.allclose(joints_deg(world), PARK_DEG, atol=0.01)


def test_asked_to_close_it_makes_all_safe_and_ends(asked: Bench, world: World) -> None:
    assert asked.done("close")["trouble"] == []
    assert asked.process.wait(cells.PATIENCE_S) == 0
    assert cells.safe(world)
    assert not asked.path.exists()


def test_a_stopped_bench_is_named_by_who_asks_it_moves_nothing_later_and_says_why_it_ended(
    cell: CellFolder, world: World
) -> None:
    stopped = cells.start("bench", cell.rig, "--yes", "--json")
    assert stopped.stdout is not None
    assert stopped.stdout.readline()
    before_deg = joints_deg(world)
    stopped.send_signal(signal.SIGSTOP)
    try:
        driven = cells.start("arm", cell.rig, "home", "--yes")
        assert driven.stderr is not None
        assert f"no answer of its bench yet: process {stopped.pid} is stopped" in driven.stderr.readline()
        driven.send_signal(signal.SIGINT)
        given_up = cells.finish(driven)
    finally:
        stopped.send_signal(signal.SIGCONT)
    assert given_up.code == 130
    assert (
        "stopped waiting for an answer: the bench will not move the arm or light an LED for this request later"
        in given_up.err
    )
    ended = cells.finish(stopped)
    assert ended.code == 130
    assert "the program did not run for" in ended.err
    assert np.allclose(joints_deg(world), before_deg, atol=0.01)


def test_no_light_outlasts_a_bench_that_is_killed(asked: Bench, cell: CellFolder, world: World) -> None:
    if asked.path.exists():
        asked.done("close")
    asked.process.wait(cells.PATIENCE_S)
    doomed = begun(cell.rig)
    client = subprocess.Popen(
        [sys.executable, "-c", ASKS, str(doomed.path), json.dumps({"exposure_us": 1_500_000, "panels": [1]})],
        stderr=subprocess.DEVNULL,
    )
    with client:
        cells.wait_until(lambda: not dark(world), "the light")
        doomed.process.kill()
        killed_s = world.ask("state")["t_s"]
        cells.finish(doomed.process)
        dark_s = cells.wait_until(lambda: dark(world) and world.ask("state")["t_s"], "the dark")
    assert dark_s - killed_s < 3.0, "the box's watchdog of 2 s"
