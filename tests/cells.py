"""A small simulated cell for tests: writes its rig and plan, runs the real commands on it, reads what they left.

Frames have 128 x 96 pixels of the demo's field of view (24576 bytes, six pages) and lie in the test's folder.
"""

from __future__ import annotations

import contextlib
import io
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import h5py
import numpy as np
import trimesh
import xxhash
from numpy.typing import NDArray
from places import REPO
from ruamel.yaml import YAML
from trimesh.ray.ray_pyembree import RayMeshIntersector

from coupole.acquisition.signals import ENDING
from coupole.commands import cli
from coupole.preflight.job import read_job
from coupole.preflight.simulated_world import world_config
from sim.world.client import World

BLACK_DN = 64
PIXEL_STEP = 7
"""Of the object's pixels every so-manieth is looked at to tell LEDs apart, in frames of 128 columns."""
PATIENCE_S = 60.0
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


@dataclass
class CellFolder:
    """Rig and plan in a folder; `speed` is the world's pace."""

    folder: Path
    speed: float = 5.0
    write_now: bool = True
    rig_data: dict[str, Any] = field(init=False)
    plan_data: dict[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        rig = YAML(typ="safe").load(REPO / "configs/rigs/sim.yaml")
        rig["sensor"] |= {"width_px": 128, "height_px": 96, "pixel_pitch_um": 176.0}
        rig["dome"]["leds"] = str(REPO / "configs/domes/coupole.csv")
        rig["robot"]["settings"] = {"cycle_ms": 12}  # a third of the work that one of 4 ms is
        rig["ledbox"]["settings"]["watchdog_s"] = 4 * self.speed  # of the world's time; the machine may be busy
        rig["storage"] = {"folder": str(self.folder / "storage"), "reserve_bytes": 0}
        rig["ledger"] = str(self.folder / "ledger")
        settings = {"seed": 1, "speed": self.speed, "arm_shadows": False}  # `Expectation` knows of no arm
        rig["world"] = {"serves": "always", "settings": settings}
        self.rig_data = rig
        self.plan_data = {
            "schema_version": 1,
            "name": "small",
            "rig": "rig.yaml",
            "object": {"id": "relief", "mesh": str(REPO / "configs/objects/relief.ply")},
            "views": [TOP],
            "lights": SOME_LIGHTS,
            "exposure": {"kind": "fixed", "exposure_us": 8000},
        }
        if self.write_now:
            self.write()

    def moved_by_ur(self, model: str) -> None:
        """From now on the arm is a UR, where the rig that comes with it has it."""
        shipped = YAML(typ="safe").load(
            REPO / f"configs/rigs/{'sim-ur' if model == 'ur10e' else 'sim-' + model}.yaml"
        )
        self.rig_data |= {key: shipped[key] for key in ("robot", "motion", "support")}
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
        config["settings"] |= {"seed": 1, "arm_shadows": False, "faults": list(faults), **settings}
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
    return Ended(code, out.getvalue(), err.getvalue())


def start(*arguments: str | Path, **popen: Any) -> subprocess.Popen[str]:
    """Run a command as a process; nobody types at it."""
    options: dict[str, Any] = {
        "stdin": subprocess.DEVNULL,
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
        "cwd": REPO,
        **popen,
    }
    return subprocess.Popen([sys.executable, "-m", "coupole.commands.cli", *map(str, arguments)], **options)


def finish(process: subprocess.Popen[str]) -> Ended:
    """Wait for a process that `start` started."""
    with process:
        out, err = process.communicate(timeout=PATIENCE_S)
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
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def children(pid: int) -> list[int]:
    """Processes that a process started and that run still."""
    return [
        int(word)
        for task in Path(f"/proc/{pid}/task").iterdir()
        for word in (task / "children").read_text().split()
    ]


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


# -- what frames must show ------------------------------------------------------------------------------------


class Expectation:
    """What each LED of the dome must make of one view, reckoned here: Lambert's law on the object's triangles that
    see the LED.

    Nothing of the simulator's is used; the pose is the measured one, the lens a pinhole.
    """

    def __init__(self, cell: CellFolder, base_from_camera: NDArray[np.float64]) -> None:
        mesh = trimesh.load(cell.plan_data["object"]["mesh"], process=False, force="mesh")
        base_from_support = transform_of(cell.rig_data["support"]["base_from_support"])
        corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)] @ base_from_support[:3, :3].T
        corners += base_from_support[:3, 3]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        points = corners.mean(axis=1)
        triangle = _triangle_of_pixel(cell, base_from_camera, corners, normals)
        step = PIXEL_STEP * max(1, cell.rig_data["sensor"]["width_px"] // 128) ** 2
        self._rows, self._columns = (places[::step] for places in np.nonzero(triangle >= 0))
        seen = triangle[self._rows, self._columns]
        self._cell = 2 * (self._rows % 2) + self._columns % 2
        table = np.loadtxt(
            cell.rig_data["dome"]["leds"], delimiter=",", comments="#", skiprows=_table_starts(cell)
        )
        self.leds = table[:, 0].astype(int)
        to_led = table[:, None, 2:5] - points[seen]
        distance = np.linalg.norm(to_led, axis=2)
        cos_object = np.einsum("lpk,pk->lp", to_led, normals[seen]) / distance
        cos_led = -np.einsum("lpk,lk->lp", to_led, table[:, 5:8]) / distance
        lit = table[:, 8:9] * np.clip(cos_object, 0, None) * np.clip(cos_led, 0, None) / distance**2
        rays = RayMeshIntersector(
            trimesh.Trimesh(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3), process=False)
        )
        origins = np.broadcast_to(points[seen] + 1e-3 * normals[seen], to_led.shape)
        lit[rays.intersects_any(origins.reshape(-1, 3), to_led.reshape(-1, 3)).reshape(lit.shape)] = 0.0
        axis = base_from_camera[:3, 2]
        from_lens = points[seen] - base_from_camera[:3, 3]
        cos_lens = from_lens @ axis / np.linalg.norm(from_lens, axis=1)
        self._pictures = self._alike(lit * cos_lens**4)  # the lens darkens towards the corners

    def led_of(self, pixels: NDArray[np.uint16]) -> int:
        """The LED, of all in the dome, whose picture this frame is most like."""
        values = pixels[self._rows, self._columns].astype(float) - BLACK_DN
        return int(self.leds[np.argmax(self._pictures @ self._alike(values[None])[0])])

    def _alike(self, pictures: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pictures [n, pixels] without the colours of the Bayer filter, of unit norm."""
        for place in range(4):
            mine = self._cell == place
            pictures[:, mine] /= np.maximum(pictures[:, mine].mean(axis=1, keepdims=True), 1e-9)
        pictures = pictures - pictures.mean(axis=1, keepdims=True)
        return pictures / np.maximum(np.linalg.norm(pictures, axis=1, keepdims=True), 1e-9)


def _triangle_of_pixel(
    cell: CellFolder,
    base_from_camera: NDArray[np.float64],
    corners: NDArray[np.float64],
    normals: NDArray[np.float64],
) -> NDArray[np.int64]:
    """[height, width] the nearest triangle [n, 3, 3] that each pixel's centre sees, -1 for none. All triangles at
    once, pixel by pixel of the largest one's bounding box; those that turn their backs are left out."""
    height, width = cell.rig_data["sensor"]["height_px"], cell.rig_data["sensor"]["width_px"]
    facing = np.flatnonzero(np.einsum("nk,nk->n", base_from_camera[:3, 3] - corners[:, 0], normals) > 0)
    column, row, depth = (
        values.reshape(-1, 3) for values in project(cell, base_from_camera, corners[facing].reshape(-1, 3))
    )
    left, top = np.ceil(column.min(axis=1)).astype(int), np.ceil(row.min(axis=1)).astype(int)
    seen, nearest = np.full((height, width), -1), np.full((height, width), np.inf)
    for down in range(int(np.ptp(row, axis=1).max()) + 1):
        for right in range(int(np.ptp(column, axis=1).max()) + 1):
            x, y = left + right, top + down
            edges = [
                (column[:, k - 2] - x) * (row[:, k - 1] - y) - (column[:, k - 1] - x) * (row[:, k - 2] - y)
                for k in range(3)
            ]
            area = sum(edges)
            inside = np.all([edge * np.sign(area) >= 0 for edge in edges], axis=0) & (area != 0)
            hit = np.flatnonzero(inside & (x >= 0) & (x < width) & (y >= 0) & (y < height))
            share = np.stack([edge[hit] / area[hit] for edge in edges], axis=1)
            here_mm = 1 / (share / depth[hit]).sum(axis=1)
            far_first = np.argsort(-here_mm)
            hit, here_mm = hit[far_first], here_mm[far_first]
            hit, here_mm = hit[here_mm < nearest[y[hit], x[hit]]], here_mm[here_mm < nearest[y[hit], x[hit]]]
            nearest[y[hit], x[hit]], seen[y[hit], x[hit]] = here_mm, facing[hit]
    return seen


def _table_starts(cell: CellFolder) -> int:
    lines = Path(cell.rig_data["dome"]["leds"]).read_text().splitlines()
    return next(i for i, line in enumerate(lines) if line.startswith("id")) + 1


def transform_of(pose: dict[str, Any]) -> NDArray[np.float64]:
    """4x4 of a pose in a rig or plan: R = Rz(A) Ry(B) Rx(C)."""
    a, b, c = np.radians(pose.get("abc_deg", (0, 0, 0)))
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(c), -np.sin(c)], [0, np.sin(c), np.cos(c)]])
    matrix = np.eye(4)
    matrix[:3, :3] = about_z @ about_y @ about_x
    matrix[:3, 3] = pose.get("translation_mm", (0, 0, 0))
    return matrix


def project(
    cell: CellFolder, base_from_camera: NDArray[np.float64], points_base_mm: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Column and row in pixels, and depth in mm, of points [n, 3]: a pinhole whose axis pierces the centre."""
    sensor, lens = cell.rig_data["sensor"], cell.rig_data["lens"]
    image_mm = 1 / (1 / lens["focal_length_mm"] - 1 / lens["focus_distance_mm"])
    in_camera = (points_base_mm - base_from_camera[:3, 3]) @ base_from_camera[:3, :3]
    scale = image_mm / (sensor["pixel_pitch_um"] * 1e-3) / in_camera[:, 2]
    column = in_camera[:, 0] * scale + (sensor["width_px"] - 1) / 2
    row = in_camera[:, 1] * scale + (sensor["height_px"] - 1) / 2
    return column, row, in_camera[:, 2]


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


def mislabelled(cell: CellFolder, run: Path) -> list[str]:
    """Shots whose picture is more like that of another LED than their own, and dark frames that are not dark."""
    wrong = []
    expectations: dict[str, Expectation] = {}
    for shot, frame in stored(run).items():
        view, light = shot.split("/")[:2]
        if not is_light(shot):
            wrong += [f"{shot} is not dark"] if abs(frame.pixels.mean() - BLACK_DN) > 2 else []
            continue
        if view not in expectations:
            expectations[view] = Expectation(cell, frame.base_from_camera)
        led = expectations[view].led_of(frame.pixels)
        assert frame.record["led"] == int(light.removeprefix("led")), shot
        if led != frame.record["led"]:
            wrong.append(f"{shot} shows LED {led}")
    return wrong
