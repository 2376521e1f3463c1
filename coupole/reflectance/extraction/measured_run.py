"""Data of a measured run: its frames, the object's triangles, and the calibrations that give them units.

The run's own folder is sufficient, because it holds plan, rig, mesh and records.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.calibrated_arm import calibrated_poses, has_axis_zeros, read_arm
from coupole.calibration.earlier import read_accepted, read_earlier, refuse_read_otherwise
from coupole.calibration.light.frames import LightFrame, LightFrames, channels_of, open_light_frames
from coupole.calibration.light.irradiance import Emission
from coupole.calibration.light.led_power_tile import calibrated_positions
from coupole.calibration.light.tile_views import Positions
from coupole.calibration.optics import Intrinsics
from coupole.calibration.posed_camera import CameraPrior, read_posed_camera
from coupole.calibration.record import Record, read_record
from coupole.errors import InputError
from coupole.geometry import apply
from coupole.plan.reading import read_plan
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import described_arm
from coupole.preflight.object_shape import MM_PER_UNIT
from coupole.reflectance.extraction.pointing import Pointing, pointings
from coupole.scan.mesh_files import read_mesh
from coupole.storage.run import Run

Floats = NDArray[np.float64]

NEEDED = ("hand-eye", "leds", "led-power")
USED = (*NEEDED, "dark", "response", "flat-field", "glare", "camera", "drift")
U_SIGNAL = {"response": "uncertainty of linearity", "flat-field": "uncertainty", "drift": "uncertainty"}
"""Kinds of records with an uncertainty that all samples share, and the first words of the limit that states it."""
TYPICAL_PER_K = -0.003
"""Relative change of the power of white LEDs with temperature, per K."""
SAME_GAIN_DB = 0.01
MOST_MOVED_MM = 0.1
"""Largest movement within a view. When a run is resumed, an arm returns to a pose within less than this."""
_HOW = (
    "name them with --calibrations, or make them: `coupole calibrate all --rig RIG`; --uncalibrated gives "
    "relative values of single pixels without them"
)


@dataclass(frozen=True)
class MeasuredView:
    """Frames of one view under single LEDs, all taken at one pose."""

    name: str
    base_from_camera: Floats
    """[4, 4] mm, from the hand-eye record, with the arm's axis zeros applied."""
    frames: tuple[LightFrame, ...]
    pointing: Pointing
    """Uncertainty of the direction in which the camera looks."""

    @cached_property
    def by_led(self) -> dict[int, list[LightFrame]]:
        """Frames of each LED, in rising order of LEDs."""
        frames_of_led: dict[int, list[LightFrame]] = {}
        for frame in self.frames:
            if frame.led is not None:
                frames_of_led.setdefault(frame.led, []).append(frame)
        return dict(sorted(frames_of_led.items()))


@dataclass(frozen=True)
class Powers:
    """Power of the LEDs in a record, by channel."""

    ids: NDArray[np.int64]
    power: Floats
    """[leds, channels] DN s^-1 m^2 sr; NaN or 0 for an LED without power."""
    board_c: Floats
    """[leds] temperature of the board for which the power is valid."""
    u_own: Floats
    """[leds, channels] relative standard uncertainty that an LED shares with no other LED."""
    u_shared: Floats
    """[leds, channels] relative standard uncertainty that all LEDs share: it comes from the tile and its place."""

    @cached_property
    def _row(self) -> dict[int, int]:
        return {int(led): number for number, led in enumerate(self.ids)}

    def of(self, leds: NDArray[np.int64]) -> Powers:
        """Return the powers of some LEDs; NaN for LEDs that are not in the record."""
        rows = np.array([self._row.get(int(led), -1) for led in leds])

        def values_of_leds(values: Floats) -> Floats:
            led_values: Floats = values[rows]
            led_values[rows < 0] = np.nan
            return led_values

        return Powers(leds, *map(values_of_leds, (self.power, self.board_c, self.u_own, self.u_shared)))


@dataclass(frozen=True)
class Drift:
    """Power of the LEDs, relative to their calibrated power: its logarithm is level + rate_per_h (t - start_s) /
    3600 + per_k dT."""

    level: float = 0.0
    rate_per_h: float = 0.0
    per_k: float = TYPICAL_PER_K
    start_s: float = 0.0

    def factor(self, warmer_k: float, t_s: float) -> float:
        """Return the factor of the power; a temperature that is not known counts as no change."""
        hours = (t_s - self.start_s) / 3600.0
        return float(np.exp(self.level + self.rate_per_h * hours + self.per_k * np.nan_to_num(warmer_k)))


@dataclass(frozen=True)
class MeasuredRun:
    """A run with all data that turn its DN into reflectance."""

    run: Run
    frames: LightFrames
    views: tuple[MeasuredView, ...]
    lens: Intrinsics
    corners_mm: Floats
    """[triangles, 3, 3] corners in the base frame."""
    triangles: NDArray[np.uint32]
    """[triangles, 3] for each triangle the rows of its vertices in the mesh."""
    leds: Positions
    powers: Powers
    emission: Emission
    records: Mapping[str, Path]
    """Files of the calibration records, by kind."""
    led_u_mm: float
    """Standard uncertainty of each coordinate of an LED's place, from the record, for the median LED."""
    mesh_path: Path
    optics: tuple[float, float, float]
    """Focal length and focus distance in mm, f-number."""
    base_from_support: Floats
    drift: Drift
    direct_light_alone: bool
    """True if the cell is simulated without inter-reflection."""
    camera: CameraPrior
    """Lens and hand-eye with their covariance; `axis_sensitivity` has the order of `views`."""
    u_signal: float = 0.0
    """Relative standard uncertainty that all samples share, from response, fall-off and drift."""

    def power_of(self, frame: LightFrame) -> Floats:
        """[channels] power of a frame's LED at the frame's time and the temperature of its board; NaN where there
        is none."""
        powers = self.powers.of(np.array([frame.led]))
        warmer_k = frame.temperature_c - float(powers.board_c[0])
        power: Floats = powers.power[0] * self.drift.factor(warmer_k, frame.t_s)
        return power

    @property
    def channels(self) -> tuple[str, ...]:
        return channels_of(self.frames.pattern)


def read_measured_run(folder: Path, mesh: Path | None = None, records: Sequence[Path] = ()) -> MeasuredRun:
    """Return a run with the records that are named here, else with the records of its plan. Raises InputError with
    the remedy if there is no mesh, a record is missing or does not belong to the run, or no frame under a single
    LED is proven."""
    run = Run(folder)
    files = read_plan(run.plan_path, run.rig_path)
    mesh_path = mesh or files.mesh_path
    if mesh_path is None or files.plan.object is None:
        raise InputError(f"{folder}: its plan names no mesh of the object; name it with --mesh")
    by_kind = records_by_kind(records or files.record_paths or ())
    if missing := [kind for kind in NEEDED if kind not in by_kind]:
        raise InputError(f"{folder}: no calibration record of the kind {', '.join(missing)} is named; {_HOW}")
    frames = open_light_frames([folder])
    hand_eye = by_kind["hand-eye"]
    prior = read_posed_camera(hand_eye, by_kind.get("camera"), frames.about, frames.size_px)
    base_from_support = files.cell.rig.support.base_from_support.matrix()
    power_record = read_earlier(by_kind["led-power"], "led-power", frames.about, frames.size_px)
    refuse_other_gain(by_kind["led-power"], power_record, frames.gain_db)
    refuse_read_otherwise(by_kind["led-power"], power_record, by_kind)
    lens, leds = files.cell.rig.lens, calibrated_positions(by_kind["leds"])
    shape = read_mesh(mesh_path)
    base_from_object = base_from_support @ files.plan.object.support_from_object.matrix()
    vertices_mm = apply(base_from_object, shape.vertices * MM_PER_UNIT[files.plan.object.mesh_unit])
    middle_mm = vertices_mm[np.unique(shape.triangles)].mean(axis=0)
    views, prior = _views(run, frames, hand_eye, files.cell.rig, prior, middle_mm)
    _refuse_unknown_leds(by_kind["leds"], leds, views)
    return MeasuredRun(
        run,
        frames,
        views,
        prior.lens,
        vertices_mm[shape.triangles],
        shape.triangles,
        leds,
        read_powers(by_kind["led-power"], channels_of(frames.pattern)),
        emission_of(power_record),
        by_kind,
        read_accepted(by_kind["leds"], "leds").value("led_centre_median_u_mm"),
        mesh_path,
        (lens.focal_length_mm, lens.focus_distance_mm, lens.f_number),
        base_from_support,
        _drift(by_kind.get("drift")),
        run.is_simulated and _direct_light_alone(files.cell.rig),
        prior,
        u_signal_of(by_kind),
    )


def _direct_light_alone(rig: Rig) -> bool:
    """Tell whether the simulated world has direct light only, by its settings (docs/reference/rig.md)."""
    world = {} if rig.world is None else rig.world.settings
    interreflection = world.get("interreflection")
    return world.get("shading") == "flat" if interreflection is None else interreflection is False


def emission_of(record: Record) -> Emission:
    """Return the emission with which a record's powers were fitted; the same emission must turn them into
    irradiance."""
    return "paper" if any("emission profile `paper`" in remark for remark in record.remarks) else "lambertian"


def read_powers(path: Path, channels: Sequence[str]) -> Powers:
    """Read the table beside a record of the kind `led-power`. Raises InputError for a record with other
    channels."""
    record = read_accepted(path, "led-power")
    table = path.parent / record.files[0].name
    lines = [line for line in table.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    if absent := [channel for channel in channels if f"power_{channel}" not in rows[0]]:
        raise InputError(f"{path}: has no LED power for the channel {absent[0]}; make a record with this camera")

    def column(name: str) -> Floats:
        return np.stack([[float(row[f"{name}_{channel}"]) for channel in channels] for row in rows])

    whole, u_own = column("u"), column("u_own")
    u_shared = np.sqrt(np.maximum(whole**2 - u_own**2, 0.0))
    board_c = np.array([float(row["board_c"]) for row in rows])
    return Powers(np.array([int(row["id"]) for row in rows]), column("power"), board_c, u_own, u_shared)


def refuse_different(measured_runs: Sequence[MeasuredRun]) -> None:
    """Raise InputError for two runs with one name, and for runs with different objects or sensors."""
    first = measured_runs[0]
    names = [measured_run.run.folder.name for measured_run in measured_runs]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(f"{twice}: two runs have this name; rename the folder of one, or name each run once")
    for other_run in measured_runs[1:]:
        if not np.array_equal(first.corners_mm, other_run.corners_mm):
            raise InputError(
                f"{other_run.run.folder}: shows another object, or the object in another place, than "
                f"{first.run.folder}"
            )
        if first.channels != other_run.channels:
            raise InputError(f"{other_run.run.folder}: was taken with another sensor than {first.run.folder}")


# -- helpers --------------------------------------------------------------------------------------------------


def refuse_other_gain(path: Path, record: Record, gain_db: float) -> None:
    """Raise InputError for a record of powers that was made at a different gain from the frames."""
    record_db = record.fixed.get("gain_db", 0.0)
    if abs(record_db - gain_db) > SAME_GAIN_DB:
        raise InputError(
            f"{path}: is valid for a gain of {record_db:g} dB; the run has {gain_db:g} dB. "
            "Name a record of this gain"
        )


def _refuse_unknown_leds(path: Path, leds: Positions, views: Sequence[MeasuredView]) -> None:
    lit = {led for view in views for led in view.by_led}
    if unknown := sorted(lit - set(map(int, leds.ids))):
        raise InputError(f"{path}: does not have LED {unknown[0]}, which the run has lit; calibrate the LEDs anew")


def _drift(path: Path | None) -> Drift:
    """Return the drift from a record of the run's own drift. Without a record, use the usual loss of power of
    white LEDs with temperature."""
    if path is None:
        return Drift()
    record = read_accepted(path, "drift")
    return Drift(*(record.value(name) for name in ("level", "rate_per_h", "per_k", "start_s")))


def u_signal_of(records: Mapping[str, Path]) -> float:
    """Return the uncertainty of the signal, from the acceptance figures of the records of the kinds in
    `U_SIGNAL`."""
    square = 0.0
    for kind, prefix in U_SIGNAL.items():
        if kind in records:
            square += sum(
                limit.found**2 for limit in read_record(records[kind]).limits if limit.what.startswith(prefix)
            )
    return math.sqrt(square)


def records_by_kind(paths: Sequence[Path]) -> dict[str, Path]:
    """Return the records by their kind, without those that are not used. Raises InputError for two records of a
    kind."""
    path_of_kind: dict[str, Path] = {}
    for path in paths:
        kind = read_record(path).kind
        if kind in path_of_kind:
            raise InputError(f"{path} and {path_of_kind[kind]} are both of the kind `{kind}`; name one of them")
        if kind in USED:
            path_of_kind[kind] = path
    return path_of_kind


def _views(
    run: Run, frames: LightFrames, hand_eye: Path, rig: Rig, prior: CameraPrior, middle_mm: Floats
) -> tuple[tuple[MeasuredView, ...], CameraPrior]:
    """Return the frames of an object by view, with the camera's pose from the record; and the record for these
    views."""
    lit: dict[str, list[LightFrame]] = {}
    for frame in frames.lit:
        if frame.led is not None:
            lit.setdefault(frame.view, []).append(frame)
    if not lit:
        raise InputError(f"{run.folder}: no proven frame under a single LED; acquire the plan first")
    poses = {name: _only_pose(run, name, view_frames) for name, view_frames in lit.items()}
    base_from_flange = np.stack(list(poses.values()))
    if has_axis_zeros(hand_eye):
        arm = described_arm(rig)
        if arm is None:
            raise InputError(f"{hand_eye}: has zeros of axes, but the run's rig describes no arm")
        joints_deg = np.stack(
            [view_frames[0].joints_deg for view_frames in lit.values() if view_frames[0].joints_deg is not None]
        )
        calibration = read_arm(hand_eye, arm.arm)
        base_from_flange, prior = calibrated_poses(base_from_flange, joints_deg, calibration, prior)
    base_from_camera = base_from_flange @ prior.flange_from_camera
    views = zip(lit.items(), base_from_camera, pointings(prior, base_from_camera, middle_mm), strict=True)
    return tuple(
        MeasuredView(name, pose, tuple(view_frames), pointing) for (name, view_frames), pose, pointing in views
    ), prior


def _only_pose(run: Run, view: str, frames: Sequence[LightFrame]) -> Floats:
    """[4, 4] base_from_flange. Raises InputError if the arm was moved within the view, for example after a
    fault."""
    first = frames[0].base_from_flange
    off_mm = max(float(np.linalg.norm(frame.base_from_flange[:3, 3] - first[:3, 3])) for frame in frames)
    if off_mm > MOST_MOVED_MM:
        raise InputError(
            f"{run.folder}: the camera stood in two places in the view {view}, {off_mm:.3f} mm apart; acquire "
            "this view again in a run of its own, and name both runs"
        )
    return first
