"""A run of LED frames, read from its files: which frames count, what is subtracted, where the camera stood."""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np
import pytest
from archives import METADATA
from bright_squares import covered, raw, square
from synthesis import Array

from coupole.calibration.leds.sources import find_leds
from coupole.devices import ArmState, FrameFormat
from coupole.errors import InputError
from coupole.plan.led_table import LedTable
from coupole.storage.frame_file_creation import create
from coupole.storage.journal import Journal
from coupole.storage.journal_events import FrameProven, SessionStarted, SessionStopped
from coupole.storage.run import Run
from coupole.storage.run_inputs import Inputs
from coupole.storage.view_writer import ViewWriter

SHAPE = (96, 128)
FORMAT = FrameFormat(
    height_px=SHAPE[0], width_px=SHAPE[1], bit_depth=12, bayer_pattern="GBRG", black_dn=64, white_dn=4095
)
TABLE = LedTable(np.arange(12), np.arange(12) // 6, np.zeros((12, 3)), np.tile([0.0, 0, 1], (12, 1)), np.ones(12))
WHERE = {"led0003": (40.0, 50.0), "led0007": (90.3, 30.6)}


def write_run(folder: Path, labels: tuple[str, ...], *, hot: bool = False) -> Run:
    """Two views of some lights; hot: all frames have a patch that is white without light."""
    folder.mkdir(parents=True)
    for name in ("plan.yaml", "rig.yaml"):
        (folder / name).write_text(f"# {name}\n")
    views = ["v0", "v1"]
    about = {"views": views, "labels": list(labels), "simulated": True}
    run = Run.create(folder, "leds", Inputs(folder / "plan.yaml", folder / "rig.yaml", ()), about)
    diary, random = Journal(run.journal_path), np.random.default_rng(8)
    diary.write(SessionStarted())
    for number, view in enumerate(views):
        path = run.view_path(view)
        create(path, len(labels), FORMAT, {**METADATA, "title": view, "focus_distance_mm": 335.0})
        writer = ViewWriter(path, {})
        pose = np.eye(4)
        pose[0, 3] = 100.0 * number
        at = writer.add_pose(ArmState((0, -90, 90, 0, 90, 0), pose, 7, moving=False), pose)
        for slot_number, label in enumerate(labels):
            pixels = np.frombuffer(mmap.mmap(-1, FORMAT.frame_bytes), np.uint16).reshape(SHAPE)
            pixels[:] = raw(_picture(label), random)
            if hot:
                pixels[70:84, 100:116] = 4095
            exposure_us = 1000 if label.endswith("e0") else 8000
            slot = writer.store(pixels, frame_id=slot_number, camera_ns=slot_number, exposure_us=exposure_us)
            digest = writer.prove(
                slot, f"{view}/{label}", led=slot_number, pose=at, board_temperature_dc=251, led_current_ma=700
            )
            file = str(path.relative_to(run.folder))
            diary.write(
                FrameProven(shot=f"{view}/{label}", file=file, index=slot, frame_id=slot, xxh3=f"{digest:016x}")
            )
        writer.sync()
        writer.close()
    diary.write(SessionStopped(outcome="done"))
    diary.commit()
    diary.close()
    return run


def _picture(label: str) -> Array:
    light = label.partition("/")[0]
    if light not in WHERE:
        return np.zeros(SHAPE)
    return 3e3 * covered(SHAPE, square(np.array(WHERE[light]), 16.0))


def test_each_led_is_found_in_each_view_at_its_pose(tmp_path: Path) -> None:
    run = write_run(tmp_path / "in", ("dark0/e0", "led0003/e0", "led0007/e0"))
    images = find_leds([run.folder], TABLE)
    assert images.views == ("v0", "v1")
    assert images.size_px == (128, 96)
    assert sorted(zip(images.seen.view.tolist(), images.seen.led.tolist(), strict=True)) == [
        (0, 3), (0, 7), (1, 3), (1, 7),
    ]  # fmt: skip
    for led, place in ((3, WHERE["led0003"]), (7, WHERE["led0007"])):
        assert np.abs(images.seen.pixels[images.seen.led == led] - place).max() < 0.2
    assert np.allclose(images.base_from_flange[:, 0, 3], [0.0, 100.0])
    assert images.about.focus_distance_mm == 335.0


def test_an_led_that_stays_dark_is_a_frame_without_a_spot(tmp_path: Path) -> None:
    run = write_run(tmp_path / "in", ("dark0/e0", "led0003/e0", "led0005/e0"))
    seen = find_leds([run.folder], TABLE).seen
    assert 5 not in seen.led
    assert (seen.frames[:, 1] == 5).sum() == 2


def test_what_is_white_in_the_dark_frame_is_no_spot(tmp_path: Path) -> None:
    run = write_run(tmp_path / "in", ("dark0/e0", "led0003/e0"), hot=True)
    assert len(find_leds([run.folder], TABLE).seen.led) == 2


def test_of_several_exposures_the_shortest_counts(tmp_path: Path) -> None:
    run = write_run(tmp_path / "in", ("dark0/e0", "led0003/e0", "led0003/e1"))
    assert len(find_leds([run.folder], TABLE).seen.frames) == 2


def test_a_run_without_single_leds_is_refused(tmp_path: Path) -> None:
    run = write_run(tmp_path / "in", ("dark0/e0", "panel1/e0"))
    with pytest.raises(InputError, match="no proven frame under a single LED"):
        find_leds([run.folder], TABLE)


def test_an_led_that_the_dome_does_not_have_is_refused(tmp_path: Path) -> None:
    run = write_run(tmp_path / "in", ("dark0/e0", "led0044/e0"))
    with pytest.raises(InputError, match=r"LEDs \[44\] are not in the dome's table"):
        find_leds([run.folder], TABLE)
