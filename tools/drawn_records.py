"""Calibration records of the simulated cell with random errors: the truth, plus a draw from the covariance that
the shipped records (`configs/calibrations`) state.

The draw has lens, hand-eye and axis zeros together; positions and normals of the LEDs, with the part that
neighbours share; and their powers. A power has its own error, and the errors of the tile that all LEDs share, by
the tile's sensitivities. The records of the flat field and of the response are the shipped ones, which contain
their own errors.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coupole.appearance.render.led_squares import Leds, read_leds
from coupole.calibration.record import Record, content_sha256, read_record, write_record
from coupole.geometry import abc_from_rotation
from coupole.plan.cell import Cell, read_cell
from sim.optics.objective import Objective, vignetting
from sim.optics.sensor_model import SensorModel
from sim.render.emitter import LED_SIDE_MM, irradiance_of_each, squares
from sim.world.config import WHITE_SHARE

ROOT = Path(__file__).resolve().parent.parent
SHIPPED, RIG = ROOT / "configs/calibrations", ROOT / "configs/rigs/sim.yaml"
KEPT = ("flat-field", "response")
WHITE_AT_US = 8000
CHANNELS = "RGB"
SHIPPED_SENSOR = SensorModel()
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Scale:
    """Differences from the shipped records, for cells that are known less or more accurately, or that have another
    camera."""

    led_mm: float | None = None
    """Standard uncertainty of each coordinate of an LED; None: that of the record."""
    led_normal_deg: float | None = None
    camera_mm: float | None = None
    """Standard uncertainty of each coordinate of the camera in the flange's frame."""
    pitch_um: float = 44.0
    """Pitch of the pixels."""
    size_px: tuple[int, int] | None = None
    """Width and height of another sensor with equal pixels."""
    sensor: SensorModel = SHIPPED_SENSOR


class _NoErrors(np.random.Generator):
    """Draws that are all 0."""

    def standard_normal(self, size: Any = None, *_: Any, **__: Any) -> Any:
        return np.zeros(() if size is None else size)


def draw_records(folder: Path, seed: int | None, scale: Scale | None = None) -> tuple[Path, ...]:
    """Write records with errors of this seed to a new folder; for None, write the truth with the same stated
    uncertainties. Return their paths."""
    folder.mkdir(parents=True)
    scale = scale or Scale()
    for kind in KEPT:
        for path in SHIPPED.glob(f"{kind}.*"):
            shutil.copy(path, folder)
    random = _NoErrors(np.random.PCG64()) if seed is None else np.random.default_rng((seed, 77))
    _set_sensor(folder, scale)
    _draw_hand_eye(folder, random, scale)
    _draw_leds(folder, random, scale)
    _draw_powers(folder, random)
    records = tuple(sorted(folder.glob("*.yaml")))
    for path in records if scale.size_px is not None else ():
        content = _content(read_record(path))
        if content["validity"]["size_px"] is not None:
            content["validity"]["size_px"] = scale.size_px
            write_record(path, _seal_record(content))
    return records


def write_camera_record(folder: Path) -> None:
    """Write a camera record with the lens of the drawn hand-eye record in a folder."""
    hand_eye = read_record(folder / "hand-eye.yaml")
    values = {parameter.name: parameter.value for parameter in hand_eye.parameters}
    content = _content(read_record(SHIPPED / "camera.yaml"))
    for parameter in content["parameters"]:
        parameter["value"] = values[parameter["name"]]
    content["validity"]["size_px"] = hand_eye.validity.size_px
    write_record(folder / "camera.yaml", _seal_record(content))


def true_powers() -> Floats:
    """[leds] of the simulated cell, DN s^-1 m^2 sr; equal in all channels."""
    table, cell = true_leds(), read_cell(RIG)
    base_from_support = cell.rig.support.base_from_support.matrix()
    emitters = squares(table.positions_mm, table.normals, side_mm=LED_SIDE_MM, fluxes_lm=table.flux_lm)
    white_lux = np.median(irradiance_of_each(emitters, base_from_support[:3, 3], base_from_support[:3, 2]))
    white_dn = WHITE_SHARE * (SHIPPED_SENSOR.white_dn - SHIPPED_SENSOR.black_dn)
    powers: Floats = table.flux_lm * white_dn * np.pi / (white_lux * WHITE_AT_US * 1e-6)
    return powers


def true_leds() -> Leds:
    return read_leds(ROOT / "configs/domes/coupole.csv")


def _draw_hand_eye(folder: Path, random: np.random.Generator, scale: Scale) -> None:
    """Draw lens, hand-eye and axis zeros from their common covariance; other parts of the record are not used."""
    record, cell = read_record(SHIPPED / "hand-eye.yaml"), read_cell(RIG)
    width_px, height_px = scale.size_px or (cell.rig.sensor.width_px, cell.rig.sensor.height_px)
    focal_px = 1e3 / scale.pitch_um * _image_mm(cell)
    truth = {"fx_px": focal_px, "fy_px": focal_px}
    truth |= {"cx_px": 0.5 * (width_px - 1), "cy_px": 0.5 * (height_px - 1)}
    covariance = record.covariance_matrix.copy()
    names = [parameter.name for parameter in record.parameters]
    steps = [names.index(f"flange_from_camera.{axis}_mm") for axis in "xyz"]
    if scale.camera_mm is not None:
        covariance[steps], covariance[:, steps] = 0.0, 0.0
        covariance[steps, steps] = scale.camera_mm**2
    values, vectors = np.linalg.eigh(covariance)
    draws = vectors @ (np.sqrt(np.maximum(values, 0.0)) * random.standard_normal(len(values)))
    errors = dict(zip(names, draws, strict=True))
    true_pose = cell.rig.flange_from_camera.matrix()
    shift = np.array([errors[f"flange_from_camera.{axis}_mm"] for axis in "xyz"])
    turn = np.array([errors[f"flange_from_camera.r{axis}_deg"] for axis in "xyz"])
    rotation = true_pose[:3, :3] @ Rotation.from_rotvec(turn, degrees=True).as_matrix()
    content = _content(record)
    place = (true_pose[:3, 3] + shift).tolist()
    content["transforms"]["flange_from_camera"] = {
        "translation_mm": place,
        "abc_deg": list(map(float, abc_from_rotation(rotation))),
    }
    place_of_name = dict(zip((f"flange_from_camera.{axis}_mm" for axis in "xyz"), place, strict=True))
    for parameter, variance in zip(content["parameters"], np.diag(covariance), strict=True):
        name = parameter["name"]
        parameter["u"] = float(np.sqrt(variance))
        if parameter["value"] is not None and not name.startswith("base_from_board"):
            parameter["value"] = place_of_name.get(name, truth.get(name, 0.0) + float(errors[name]))
    content["covariance"] = covariance.tolist()
    write_record(folder / "hand-eye.yaml", _seal_record(content))


def _image_mm(cell: Cell) -> float:
    """Distance of the image from the thin lens."""
    lens = cell.rig.lens
    return 1.0 / (1.0 / lens.focal_length_mm - 1.0 / lens.focus_distance_mm)


def _set_sensor(folder: Path, scale: Scale) -> None:
    """Set the noise of another sensor, and the lens's fall-off on pixels of another size; these are not drawn."""
    cell, record = read_cell(RIG), read_record(SHIPPED / "response.yaml")
    content, sensor = _content(record), scale.sensor
    if sensor != SHIPPED_SENSOR:
        for parameter in content["parameters"]:
            name = parameter["name"].split(".")[0]
            value_of_name = {
                "dark_variance_dn2": (sensor.read_noise_e / sensor.electrons_per_dn) ** 2 + 1.0 / 12.0,
                "gain_dn_per_e": 1.0 / sensor.electrons_per_dn,
            }
            parameter["value"] = value_of_name.get(name, parameter["value"])
        write_record(folder / "response.yaml", _seal_record(content))
    if scale.pitch_um == cell.rig.sensor.pixel_pitch_um and scale.size_px is None:
        return
    lens = cell.rig.lens
    width_px, height_px = scale.size_px or (cell.rig.sensor.width_px, cell.rig.sensor.height_px)
    row, column = np.indices((height_px, width_px))
    off = np.hypot(row - row.mean(), column - column.mean()) * scale.pitch_um * 1e-3 / _image_mm(cell)
    with h5py.File(folder / "flat-field.h5", "r+") as file:
        objective = Objective(lens.focal_length_mm, lens.focus_distance_mm, lens.f_number)
        fall_off = vignetting(objective, off)
        if scale.size_px is None:
            file["g"][...] = fall_off
        else:
            for name, values in (("g", fall_off), ("pixel_response", np.ones_like(fall_off))):
                del file[name]
                file[name] = values.astype(np.float32)
    content = _content(read_record(SHIPPED / "flat-field.yaml"))
    content["files"][0]["sha256"] = hashlib.sha256((folder / "flat-field.h5").read_bytes()).hexdigest()
    write_record(folder / "flat-field.yaml", _seal_record(content))


def _draw_leds(folder: Path, random: np.random.Generator, scale: Scale) -> None:
    record, truth = read_record(SHIPPED / "leds.yaml"), true_leds()
    with h5py.File(SHIPPED / "leds.h5", "r") as file:
        of_centres, shared_parts, of_normals, axes = (
            file[name][()] for name in ("centre_covariance", "shared_part", "normal_covariance", "board_axes")
        )
    content = _content(record)
    if scale.led_mm is not None:
        of_centres, shared_parts = (
            np.broadcast_to(np.eye(3) * scale.led_mm**2, of_centres.shape),
            np.zeros(len(shared_parts)),
        )
        for parameter in content["parameters"]:
            if parameter["name"] == "led_centre_median_u_mm":
                parameter["value"] = scale.led_mm
    if scale.led_normal_deg is not None:
        of_normals = np.broadcast_to(np.eye(2) * scale.led_normal_deg**2, of_normals.shape)
    roots, count = np.linalg.cholesky(of_centres), len(truth.ids)
    for_all = random.standard_normal(3)
    own_errors = random.standard_normal((count, 3)) * np.sqrt(1.0 - shared_parts)[:, None]
    centres = truth.positions_mm + np.einsum(
        "nij,nj->ni", roots, own_errors + np.sqrt(shared_parts)[:, None] * for_all
    )
    boards, board = np.unique(truth.ids // 6, return_inverse=True)
    of_boards = random.standard_normal((len(boards), 2))[board]
    turns = np.einsum("nij,nj->ni", np.linalg.cholesky(of_normals), of_boards)
    about = np.einsum("nik,nk->ni", axes, turns)
    normals = Rotation.from_rotvec(about, degrees=True).apply(truth.normals)
    lines = [line for line in (SHIPPED / "leds.csv").read_text().splitlines() if line]
    head = lines[: next(n for n, line in enumerate(lines) if line.startswith("id,")) + 1]
    rows = [line.split(",") for line in lines[len(head) :]]
    for row, centre, normal in zip(rows, centres, normals, strict=True):
        row[2:8] = [f"{value:.5f}" for value in centre] + [f"{value:.8f}" for value in normal]
    text = "\n".join([*head, *(",".join(row) for row in rows)]) + "\n"
    shutil.copy(SHIPPED / "leds.h5", folder)
    _write_with_table(folder, "leds", content, text)


def _draw_powers(folder: Path, random: np.random.Generator) -> None:
    """Return the true powers, plus each LED's own error, plus those of the tile by the table's sensitivities."""
    record = read_record(SHIPPED / "led-power.yaml")
    content, names = _content(record), [parameter.name for parameter in record.parameters]
    text = (SHIPPED / "led-power.csv").read_text()
    head, _, body = text.partition("\n")
    table = list(csv.DictReader(io.StringIO(body)))
    truth = dict(zip(map(int, true_leds().ids), true_powers(), strict=True))
    for channel in CHANNELS:
        columns = [name for name in table[0] if name.startswith("d_") and name.endswith(f"_{channel}")]
        at = [names.index(f"{name[2:-2]}.{channel}") for name in columns]
        covariance = record.covariance_matrix[np.ix_(at, at)]
        values, vectors = np.linalg.eigh(covariance)
        shared_errors = vectors @ (np.sqrt(np.maximum(values, 0.0)) * random.standard_normal(len(values)))
        for row in table:
            off = sum(float(row[name]) * error for name, error in zip(columns, shared_errors, strict=True))
            own_error = float(row[f"u_own_{channel}"]) * random.standard_normal()
            row[f"power_{channel}"] = f"{truth[int(row['id'])] * np.exp(off + own_error):.9g}"
    out = io.StringIO()
    writer = csv.DictWriter(out, list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    _write_with_table(folder, "led-power", content, f"{head}\n{out.getvalue()}")


def _write_with_table(folder: Path, kind: str, content: dict[str, Any], text: str) -> None:
    """Write a record with its CSV, whose checksum the record contains."""
    (folder / f"{kind}.csv").write_text(text)
    for file in content["files"]:
        if file["name"] == f"{kind}.csv":
            file["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    write_record(folder / f"{kind}.yaml", _seal_record(content))


def _seal_record(content: dict[str, Any]) -> Record:
    return Record.model_validate_json(json.dumps({**content, "sha256": content_sha256(content)}))


def _content(record: Record) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(record.model_dump_json(exclude={"sha256"}))
    return content
