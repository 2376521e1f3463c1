"""A small simulated cell for tests: writes its rig and plan, runs the real commands on it, reads what they left.

Frames have 128 x 96 pixels of the demo's field of view (24576 bytes, six pages) and lie in the test's folder.
"""

from __future__ import annotations

import contextlib
import gc
import io
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import h5py
import numpy as np
import xxhash
from numpy.typing import NDArray
from nursery import NURSERY
from places import REPO
from ruamel.yaml import YAML

from coupole.acquisition.signals import ENDING
from coupole.commands import cli
from coupole.preflight.job import read_job
from coupole.preflight.simulated_world import world_config
from sim.world.client import World

BLACK_DN = 64
FILES_LEFT = 100
"""Open files more than after the last collection before the next."""
PATIENCE_S = 120.0
"""How long a test waits for what must come; only a broken program lets it run out."""

TOP = {
    "kind": "look_at",
    "name": "top",
    "target_mm": [0, 0, 30],
    "distance_mm": 335,
    "azimuth_deg": -90,
    "elevation_deg": 80,
}
SIDE = {**TOP, "name": "side", "azimuth_deg": -60, "elevation_deg": 45}
LOW = {**TOP, "name": "low", "azimuth_deg": -120, "elevation_deg": 45}
RELIEF = REPO / "configs/objects/relief.ply"
COARSE_RELIEF = REPO / "tests/data/relief.ply"
"""The same on a grid four times as coarse: a run in a small cell costs a fifth less."""
PLAIN = {"seed": 1, "arm_shadows": False, "shading": "flat"}
"""Settings of worlds whose pictures `expected_pictures` can reckon: without an arm, by direct light."""
SOME_LIGHTS = {"kind": "every", "every": 20}
"""54 LEDs, all round the dome."""


@dataclass(frozen=True)
class Ended:
    """How a command ended and what it said."""

    code: int
    out: str
    err: str

    @property
    def document(self) -> dict[str, Any]:
        """The one JSON document of `--json`."""
        found: dict[str, Any] = json.loads(self.out)
        return found


def shipped_rig(name: str) -> dict[str, Any]:
    """Data of a rig of `configs`, to change at will."""
    return deepcopy(_read_rig(name))


@cache
def _read_rig(name: str) -> dict[str, Any]:
    rig: dict[str, Any] = YAML(typ="safe", pure=True).load(REPO / f"configs/rigs/{name}.yaml")
    return rig


@dataclass
class CellFolder:
    """Rig and plan in a folder; `speed` is the world's pace."""

    folder: Path
    speed: float = 5.0
    write_now: bool = True
    rig_data: dict[str, Any] = field(init=False)
    plan_data: dict[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        rig = shipped_rig("sim")
        rig["sensor"] |= {"width_px": 128, "height_px": 96, "pixel_pitch_um": 176.0}
        rig["dome"]["leds"] = str(REPO / "configs/domes/coupole.csv")
        rig["robot"]["settings"] = {
            "cycle_ms": 12,  # a third of the work that one of 4 ms is
            "attention_s": 0.5,  # a busy machine
            "controller": "192.0.2.7",  # a real one, where there is no world
        }
        rig["ledbox"]["settings"]["watchdog_s"] = 4 * self.speed  # of the world's time; the machine may be busy
        rig["storage"] = {"folder": str(self.folder / "storage"), "reserve_bytes": 0}
        rig["ledger"] = str(self.folder / "ledger")
        rig["controllers"] = str(self.folder / "controllers")
        settings = {**PLAIN, "speed": self.speed}
        rig["world"] = {"serves": "always", "settings": settings}
        self.rig_data = rig
        self.plan_data = {
            "schema_version": 1,
            "name": "small",
            "rig": "rig.yaml",
            "object": {"id": "relief", "mesh": str(COARSE_RELIEF)},
            "views": [TOP],
            "lights": SOME_LIGHTS,
            "exposure": {"kind": "fixed", "exposure_us": 8000},
        }
        if self.write_now:
            self.write()

    def moved_by_ur(self, model: str, *, patient: bool = True) -> None:
        """From now on the arm is a UR, where the rig that comes with it has it; `patient` with a busy machine."""
        shipped = shipped_rig("sim-ur" if model == "ur10e" else f"sim-{model}")
        self.rig_data |= {key: shipped[key] for key in ("robot", "motion", "support")}
        if patient:
            self.rig_data["robot"]["settings"] |= {"attention_s": 0.5, "watchdog_s": 0.5}
        self.rig_data["arm"] = str(REPO / f"configs/robots/{model}.yaml")

    @property
    def plan(self) -> Path:
        return self.folder / "plan.yaml"

    @property
    def rig(self) -> Path:
        return self.folder / "rig.yaml"

    @property
    def world_settings(self) -> dict[str, Any]:
        """The rig's `world.settings`, to change before `write()`."""
        settings: dict[str, Any] = self.rig_data["world"].setdefault("settings", {})
        return settings

    def write(self, **plan: Any) -> None:
        """Write both files, after changing some of the plan."""
        self.plan_data |= plan
        self.rig.write_text(json.dumps(self.rig_data, indent=1))
        self.plan.write_text(json.dumps(self.plan_data, indent=1))

    def faults(self, *faults: dict[str, Any]) -> None:
        """Script these faults into the rig's world."""
        self.world_settings["faults"] = list(faults)
        self.write()

    def acquire(self, *options: str | Path, typed: str = "") -> Ended:
        """`coupole acquire --json` on the plan, in this process: with the command's exit code and words."""
        return here("acquire", self.plan, "--json", "--yes", *options, typed=typed)

    def start_acquire(self, *options: str | Path, **popen: Any) -> subprocess.Popen[str]:
        """The same as a process of its own, still running."""
        return start("acquire", self.plan, "--json", "--yes", *options, **popen)

    def confirm(self) -> None:
        """A person's word after a fault of the arm."""
        assert here("confirm", self.rig, "--name", "an operator").code == 0

    @property
    def run_folder(self) -> Path:
        """The only run in the storage folder, waited for if need be."""
        found = wait_until(lambda: sorted((self.folder / "storage").glob("2*/run.json")), "a run folder")
        assert len(found) == 1
        run: Path = found[0].parent
        return run

    def join(self) -> None:
        """Have the rig join a world that `world()` keeps, in place of one of its own."""
        self.rig_data["world"] = {"join": str(self._endpoints)}
        self.write()

    @property
    def _endpoints(self) -> Path:
        return self.folder / "world.json"

    @contextmanager
    def world(self, *faults: dict[str, Any], **settings: Any) -> Iterator[World]:
        """The world that the rig joins: it outlives its controllers, and holds the plan's object."""
        job = read_job(self.plan)
        config = world_config(job.cell, job, job.cell.rig.sensor, speed=self.speed)
        config["settings"] |= {**PLAIN, "faults": list(faults), **settings}
        world = World.start(config)
        self._endpoints.write_text(json.dumps(world.endpoints) + "\n")
        try:
            yield world
        finally:
            world.close()


def here(*arguments: str | Path, typed: str = "") -> Ended:
    """Run a command in this process; `typed` is what the operator answers."""
    out, err = io.StringIO(), io.StringIO()
    before = {number: signal.getsignal(number) for number in ENDING}
    with (
        mock.patch.object(sys, "argv", ["coupole", *map(str, arguments)]),
        mock.patch.object(sys, "stdin", io.StringIO(typed)),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            cli.main()
        except SystemExit as ended:
            code = int(ended.code or 0)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
            _FREEZER.freeze()
    return Ended(code, out.getvalue(), err.getvalue())


class _Freezer:
    """A session has unfrozen what `conftest` froze: half a million objects for each collection. What it leaves in
    cycles is frozen too, with its open files; these are collected from time to time, as `select` takes no number
    above 1023."""

    most_files = FILES_LEFT

    def freeze(self) -> None:
        if _open_files() > self.most_files:
            gc.unfreeze()
            gc.collect()
            self.most_files = _open_files() + FILES_LEFT
        gc.freeze()


_FREEZER = _Freezer()


def _open_files() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


def start(*arguments: str | Path, anew: bool = False, **popen: Any) -> subprocess.Popen[str]:
    """Run a command as a process; nobody types at it. It and its world are forked where all modules are, unless it
    is asked for `anew` or with options of a process beyond its streams."""
    options: dict[str, Any] = {
        "stdin": subprocess.DEVNULL,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
        "cwd": REPO,
        **popen,
    }
    words = [*map(str, arguments)]
    if not anew and popen.keys() <= {"stdin", "stdout", "stderr"}:
        return NURSERY.command(words, **options)
    return subprocess.Popen([sys.executable, "-m", "coupole", *words], **options)


def finish(process: subprocess.Popen[str]) -> Ended:
    """Wait for a process that `start` started."""
    with process:
        out, err = process.communicate(timeout=2 * PATIENCE_S)  # the first of all compiles the kernels
    return Ended(process.returncode, out or "", err or "")


def command(*arguments: str | Path) -> Ended:
    """Run a command as a process, to its end."""
    return finish(start(*arguments))


def wait_until(condition: Callable[[], Any], what: str) -> Any:
    """Poll until `condition()` is true; returns what it gave."""
    end_s = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        assert time.monotonic() < end_s, f"waited in vain for {what}"
        time.sleep(0.02)
    return found


def alive(pid: int) -> bool:
    """True while a process runs; zombies do not."""
    return state_of(pid) != "Z"


def state_of(pid: int) -> str:
    """Of a process, as the kernel has it: T stopped, Z ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return "Z"


def children(pid: int) -> list[int]:
    """Processes that a process started and that run still."""
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a thread that has just ended
            found += map(int, (task / "children").read_text().split())
    return found


# -- what a run left ------------------------------------------------------------------------------------------


def events(run: Path, kind: str | None = None) -> list[dict[str, Any]]:
    """Lines of the journal, all or of one kind, read with nothing but json; torn lines are left out."""
    path = run / "journal.jsonl"
    found = []
    for line in path.read_bytes().split(b"\n") if path.exists() else []:
        with contextlib.suppress(json.JSONDecodeError, UnicodeDecodeError):
            found.append(json.loads(line))
    return [event for event in found if kind in (None, event["event"])]


def frame_lines(run: Path) -> int:
    """How many frames the journal calls proven."""
    path = run / "journal.jsonl"
    return path.read_bytes().count(b'{"event":"frame"') if path.exists() else 0


@dataclass(frozen=True)
class Stored:
    """One proven frame, read with nothing but h5py."""

    shot: str
    record: np.void
    pixels: NDArray[np.uint16]
    base_from_camera: NDArray[np.float64]


def stored(run: Path) -> dict[str, Stored]:
    """All proven frames of a run, by shot. Fails if one is stored twice or its bytes are not its checksum's."""
    found: dict[str, Stored] = {}
    for path in sorted((run / "views").glob("*.h5")):
        with h5py.File(path, "r") as file:
            data, table = file["entry/instrument/detector/data"][()], file["entry/instrument/detector/frames"][()]
            poses = file["entry/instrument/robot/poses"][()]
        for slot in np.flatnonzero(table["state"] == 2):
            record, pixels = table[slot], data[slot] if data.dtype == np.uint16 else unpacked(data[slot])
            shot = record["shot"].decode()
            assert shot not in found, f"{shot} is stored twice"
            assert xxhash.xxh3_64_intdigest(pixels.tobytes()) == record["xxh3"], shot
            found[shot] = Stored(shot, record, pixels, poses[record["pose"]]["base_from_camera"])
    return found


def unpacked(three: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Pixels [H, W] of a packed frame [H, 3 W / 2], as its file explains them."""
    a, middle, b = three.reshape(len(three), -1, 3).astype(np.uint16).transpose(2, 0, 1)
    return np.stack([a | (middle & 15) << 8, middle >> 4 | b << 4], axis=2).reshape(len(three), -1)


def is_light(shot: str) -> bool:
    """True for a picture under a light."""
    return "/dark" not in shot and "mark" not in shot


def assert_each_shot_proven_once(run: Path) -> None:
    """Every frame of the plan has one journal line, and `verify` finds each whole."""
    about = json.loads((run / "run.json").read_text())
    labels = about["labels"]
    expected = sorted(
        f"{view}/{label}"
        for view in about["views"]
        for label in (labels[view] if isinstance(labels, dict) else labels)
    )
    assert sorted(event["shot"] for event in events(run, "frame")) == expected
    verified = here("verify", run, "--json")
    assert verified.code == 0, verified
    assert verified.document["ok"] is True
    assert verified.document["frames"] == len(expected)
    assert verified.document["bad"] == []


def safe(world: World) -> bool:
    """True if nothing shines, the arm stands and the camera is disarmed."""
    state = world.ask("state")
    return not (state["shining"] or state["panels"] or state["arm_moving"] or state["camera_armed"])


def about(run: Path) -> dict[str, Any]:
    """The run's run.json."""
    found: dict[str, Any] = json.loads((run / "run.json").read_text())
    return found


def labels(run: Path) -> list[str]:
    """What the run's edges are for, one after the other: labels of a view's frames in the order of its burst."""
    found: list[str] = json.loads((run / "run.json").read_text())["labels"]
    return found


def reshot(run: Path) -> list[str]:
    """Shots that were taken again, in order."""
    return [shot for event in events(run, "reshoot") for shot in event["shots"]]
