"""Small runs of RAW frames, with the records that go with them: what `calibrate leds` and `mesh` are given."""

from __future__ import annotations

import json
import mmap
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from archives import METADATA
from bright_squares import BLACK_DN, WHITE_DN, covered, raw
from cells import CellFolder
from domes import SIDE_MM, SUPPORT_MM, table
from numpy.typing import NDArray
from sticker_scenes import LENS, SIZE_PX, Scene
from synthesis import Array, frame

from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.record import Input, Noise, Parameter, Validity, seal_record, step_names, write_record
from coupole.devices import ArmState, FrameFormat
from coupole.geometry import abc_from_rotation
from coupole.plan.base_model import Pose
from coupole.plan.led_table import COLUMNS, LedTable
from coupole.storage.frame_file_creation import create
from coupole.storage.journal import Journal
from coupole.storage.journal_events import FrameProven, SessionStarted, SessionStopped
from coupole.storage.run import Run
from coupole.storage.run_inputs import Inputs
from coupole.storage.view_writer import ViewWriter

FLANGE_FROM_CAMERA = frame(np.array([31.0, -42.0, 118.0]), np.array([4.0, -3.0, 60.0]))


@dataclass(frozen=True)
class Frame:
    """One frame of a view, under a light like `led0003`."""

    view: str
    light: str
    base_from_flange: Array
    pixels: NDArray[np.uint16]


def write_raw_run(folder: Path, frames: Sequence[Frame], *, pattern: str = "GBRG", room_c: float = 25.0) -> Path:
    """A run with these frames, all proven; returns its folder."""
    folder.mkdir(parents=True)
    of = FrameFormat(
        height_px=SIZE_PX[1],
        width_px=SIZE_PX[0],
        bit_depth=12,
        bayer_pattern=pattern,
        black_dn=BLACK_DN,
        white_dn=WHITE_DN,
    )
    for name in ("plan.yaml", "rig.yaml"):
        (folder / name).write_text(f"# {name}\n")
    views = list(dict.fromkeys(one.view for one in frames))
    labels = {view: [f"{one.light}/e0" for one in frames if one.view == view] for view in views}
    run = Run.create(
        folder,
        "raw",
        Inputs(folder / "plan.yaml", folder / "rig.yaml", ()),
        {"views": views, "labels": labels, "simulated": True},
    )
    diary = Journal(run.journal_path)
    diary.write(SessionStarted())
    for view in views:
        mine = [one for one in frames if one.view == view]
        path = run.view_path(view)
        create(path, len(mine), of, {**METADATA, "title": view, "focus_distance_mm": 335.0})
        writer = ViewWriter(path, {})
        flange = mine[0].base_from_flange
        arm = ArmState((0, -90, 90, 0, 90, 0), flange, 7, moving=False)
        pose = writer.add_pose(arm, flange @ FLANGE_FROM_CAMERA)
        for number, one in enumerate(mine):
            pixels = np.frombuffer(mmap.mmap(-1, of.frame_bytes), np.uint16).reshape(one.pixels.shape)
            pixels[:] = one.pixels
            slot = writer.store(pixels, frame_id=number, camera_ns=number, exposure_us=1000)
            shot = f"{view}/{one.light}/e0"
            warmth = {"board_temperature_dc": round(10 * room_c), "led_current_ma": 700}
            digest = writer.prove(slot, shot, led=number, pose=pose, **warmth)
            file = str(path.relative_to(run.folder))
            diary.write(FrameProven(shot=shot, file=file, index=slot, frame_id=number, xxh3=f"{digest:016x}"))
        writer.sync()
        writer.close()
    diary.write(SessionStopped(outcome="done"))
    diary.commit()
    diary.close()
    return run.folder


def write_hand_eye(path: Path, prior: CameraPrior, **validity: Any) -> Path:
    """The record that says what `prior` does, in force for this module's runs but for what `validity` says."""
    now = datetime.now(UTC)
    names = [f"{n}_px" if n in ("fx", "fy", "cx", "cy") else n for n in prior.free]
    names += step_names("flange_from_camera")
    units = np.concatenate([np.ones(len(prior.free) + 3), np.full(3, np.degrees(1.0))])
    covariance = prior.covariance * np.outer(units, units)
    place = prior.flange_from_camera
    x, y, z = map(float, place[:3, 3])
    said = {
        "expires": now + timedelta(days=30), "size_px": SIZE_PX, "focal_length_mm": 35.0, "f_number": 8.0,
        "focus_distance_mm": 335.0, "temperature_c": (20.0, 30.0),
    }  # fmt: skip
    record = seal_record(
        kind="hand-eye",
        name="hand-eye",
        created=now - timedelta(days=1),
        software="coupole",
        simulated=True,
        validity=Validity(**said | validity),
        transforms={
            "flange_from_camera": Pose(translation_mm=(x, y, z), abc_deg=abc_from_rotation(place[:3, :3]))
        },
        parameters=tuple(
            Parameter(
                name=name,
                value=getattr(prior.lens, free) if (free := name.removesuffix("_px")) in prior.free else None,
                u=float(np.sqrt(covariance[i, i])),
                degrees_of_freedom=100.0,
                dominated_by="corners",
            )
            for i, name in enumerate(names)
        ),
        fixed={"k3": 0.0},
        covariance=tuple(map(tuple, covariance.tolist())),
        noise=(
            Noise(name="robot position", unit="mm", stated=0.03, found=0.031, redundancy=100.0),
            Noise(name="robot orientation", unit="deg", stated=0.003, found=0.0029, redundancy=100.0),
        ),
        images=(),
        limits=(),
        remarks=(),
        inputs=(Input(name="run/run.json", sha256="0" * 64),),
    )
    write_record(path, record)
    return path


# -- LEDs -----------------------------------------------------------------------------------------------------


def led_frames(*, boards: int = 3, views: int = 8) -> tuple[LedTable, list[Frame]]:
    """A dome of few boards, each LED alone in a frame of each view; the arm has its noise."""
    random = np.random.default_rng(4)
    dome = table(boards)
    frames = []
    for number in range(views):
        eye = _eye(dome, random)
        off = frame(random.normal(0, 0.03, 3), random.normal(0, 0.003, 3))
        flange = eye @ np.linalg.inv(FLANGE_FROM_CAMERA) @ np.linalg.inv(off)
        for row, led in enumerate(dome.ids):
            picture = covered(SIZE_PX[::-1], _square(dome, row, eye))
            pixels = raw(20.0 * picture, random)
            frames.append(Frame(f"v{number}", f"led{led:04d}", flange, pixels))
    return dome, frames


def write_rig(folder: Path, dome: LedTable) -> Path:
    """A rig with this dome; returns its file."""
    rows = [
        f"{led},{board},{','.join(map(str, place))},{','.join(map(str, normal))},1800.0"
        for led, board, place, normal in zip(dome.ids, dome.boards, dome.positions_mm, dome.normals, strict=True)
    ]
    (folder / "dome.csv").write_text("\n".join([",".join(COLUMNS), *rows]) + "\n")
    cell = CellFolder(folder, write_now=False)
    cell.rig_data["dome"]["leds"] = str(folder / "dome.csv")
    cell.rig.write_text(json.dumps(cell.rig_data))
    return cell.rig


def _eye(dome: LedTable, random: np.random.Generator) -> Array:
    """`base_from_camera` of a camera about 1 m from the boards, which it looks at."""
    middle = dome.positions_mm.mean(axis=0)
    inwards = (SUPPORT_MM - middle) / np.linalg.norm(SUPPORT_MM - middle)
    place = middle + 1000.0 * inwards + random.uniform(-300, 300, 3)
    z = (middle - place) / np.linalg.norm(middle - place)
    x = np.cross(z, random.normal(size=3))
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), place
    return pose


def _square(dome: LedTable, row: int, eye: Array) -> Array:
    """Corners [4, 2] of an LED in the picture."""
    normal = dome.normals[row]
    x = np.cross(normal, [0.3, -0.5, 0.81])
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    corners = dome.positions_mm[row] + SIDE_MM / 2 * np.array([-x - y, x - y, x + y, y - x])
    return LENS.see((corners - eye[:3, 3]) @ eye[:3, :3])


# -- stickers -------------------------------------------------------------------------------------------------


def sticker_frames(made: Scene) -> list[Frame]:
    """The scene's photographs, which are of green alone, as frames of a `MONO` run."""
    assert made.sources.poses is not None
    return [
        Frame(
            source.name,
            "led0000",
            flange,
            np.clip(np.rint(source.read_picture().plane() + BLACK_DN), 0, WHITE_DN).astype(np.uint16),
        )
        for source, flange in zip(made.sources.images, made.sources.poses.base_from_flange, strict=True)
    ]
