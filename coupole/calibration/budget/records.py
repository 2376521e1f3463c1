"""Inputs of the uncertainty budget from calibration records."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, assert_never, get_args

import numpy as np

from coupole.calibration import optics
from coupole.calibration.budget.budget import Known
from coupole.calibration.in_force import InForce, read_in_force
from coupole.calibration.record import SEAL, Kind, Record, intrinsics_of, step_names
from coupole.calibration.rotations import Floats, skew
from coupole.calibration.traceability import overdue_of, trace_of
from coupole.errors import InputError

WORKING_MM = 334.0
"""Distance from camera to object for a record that has no focus distance. It follows from the field of Lucat et
al. 2025 and pixels."""
_FIELD = np.array([(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
_SEEN_FROM_HAND_EYE = "flange_from_camera"


@dataclass(frozen=True)
class Said:
    """Contribution of one record: figures of `Known` by name, and the sources of uncertainty that the figures
    describe."""

    figures: dict[str, float]
    sources: tuple[str, ...]


def read_records(paths: Sequence[Path]) -> tuple[InForce, ...]:
    """Return the records at `paths`. From a folder, the records of the kinds that a budget uses are taken. Raises
    InputError for a missing file, a folder without such a record, a record of a kind that a budget does not use,
    and two records of one kind.
    """
    records: list[InForce] = []
    for path in paths:
        if path.is_dir():
            inside = of_use(read_in_force([file for file in sorted(path.glob("*.yaml")) if _is_record(file)]))
            if not inside:
                raise InputError(f"{path}: expected records of the kinds {_KINDS} in this folder")
            records += inside
        else:
            records += read_in_force([path])
    for number, item in enumerate(records):
        if reader_of(item.record.kind) is None:
            raise InputError(
                f"{item.path}: a record of the kind `{item.record.kind}` is not used by a budget; expected "
                f"{_KINDS}"
            )
        if any(item.record.kind == earlier.record.kind for earlier in records[:number]):
            raise InputError(f"{item.path}: a second record of the kind `{item.record.kind}`; give one of each")
    return tuple(records)


def of_use(items: Sequence[InForce]) -> tuple[InForce, ...]:
    """Return the records of the kinds that a budget uses."""
    return tuple(item for item in items if reader_of(item.record.kind))


def doubts(items: Sequence[InForce], now: datetime) -> tuple[str, ...]:
    """Return reasons not to rely on records: limits that were exceeded, an expired validity, a certificate that is
    too old."""
    missed_limits = [
        f"{item.path}: not accepted: {limit.what} is {limit.found:.3g} {limit.unit}, at most {limit.limit:.3g}"
        for item in items
        for limit in item.record.limits
        if not limit.is_met
    ]
    expired_records = [
        f"{item.path}: expired on {item.record.validity.expires:%Y-%m-%d %H:%M} UTC"
        for item in items
        if now >= item.record.validity.expires
    ]
    overdue = [line for item in items for line in overdue_of(item.record, now.date())]
    return (*missed_limits, *expired_records, *overdue)


def traces(items: Sequence[InForce]) -> tuple[str, ...]:
    """Return the certificates that each record rests on, one line each."""
    return tuple(f"{_display_name(item.record)}: {line}" for item in items for line in trace_of(item.record))


def known_from(items: Sequence[InForce], start: Known) -> Known:
    """Return `start` with the figures of the records in place of its own."""
    changes: dict[str, Any] = {}
    sources: list[tuple[str, str]] = []
    kinds = {item.record.kind for item in items}
    for item in items:
        if item.record.kind == "camera" and "hand-eye" in kinds:
            continue  # rays use the lens that the hand-eye record has, with their common covariance
        reader = reader_of(item.record.kind)
        assert reader is not None  # `read_records` and `of_use` let no other pass
        statement = reader(item.record, item.path)
        changes |= statement.figures
        sources += [(group, _display_name(item.record)) for group in statement.sources]
    if {"leds", "mesh"} <= kinds:
        # No record keeps the share of the hand-eye's error in LEDs and mesh, so they count as independent. A tenth
        # of a millimetre between LED and mesh, which is more than this share, changes an irradiance by 0.02 %.
        changes["robot_mm"] = 0.0
    return replace(start, **changes, sources=tuple(sources))


def _display_name(record: Record) -> str:
    return record.name if record.kind in record.name else f"{record.kind} {record.name}"


def _is_record(file: Path) -> bool:
    with file.open(encoding="utf-8", errors="replace") as stream:
        return stream.readline().startswith(SEAL)


# -- what each kind says --------------------------------------------------------------------------------------


def _of_response(record: Record, path: Path) -> Said:
    read_noise_dn = max(record.value("dark_variance_dn2.G") - 1.0 / 12.0, 0.0) ** 0.5
    figures = {
        "gain_dn_per_e": record.value("gain_dn_per_e.G"),
        "read_noise_dn": read_noise_dn,
        "full_scale_dn": record.value("range_dn"),
        "response": _limit_found(record, path, "uncertainty of linearity"),
    }
    return Said(figures, ("pixel value", "response"))


def _of_flat_field(record: Record, path: Path) -> Said:
    return Said({"flat_field": _limit_found(record, path, "uncertainty")}, ("flat field",))


def _of_glare(record: Record, path: Path) -> Said:
    return Said({"glare": _limit_found(record, path, "uncertainty of the veil")}, ("glare",))


def _of_drift(record: Record, path: Path) -> Said:
    return Said({"drift": _limit_found(record, path, "uncertainty")}, ("drift",))


def _of_led_power(record: Record, path: Path) -> Said:
    table = next(file.name for file in record.files if file.name.endswith(".csv"))
    text = (path.parent / table).read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    names = lines[0].split(",")
    values = np.genfromtxt(lines[1:], delimiter=",", ndmin=2)
    good = values[:, names.index("power_G")] > 0
    u_own, u_all = values[good, names.index("u_own_G")], values[good, names.index("u_G")]
    common = np.sqrt(np.maximum(u_all**2 - u_own**2, 0.0))
    figures = {"power_own": float(np.median(u_own)), "power_common": float(np.median(common))}
    return Said(figures, ("LED power, own", "LED power, common"))


def _of_leds(record: Record, path: Path) -> Said:
    figures = {
        "led_mm": record.value("led_centre_median_u_mm"),
        "led_deg": record.value("led_normal_median_u_deg"),
    }
    return Said(figures, ("LED position", "LED normal"))


def _of_mesh(record: Record, path: Path) -> Said:
    """Use the uncertainty of the least certain sticker for all points of the object."""
    turn = step_names("base_from_mesh")[3:]
    u = {parameter.name: parameter.u for parameter in record.parameters}
    figures = {
        "mesh_mm": _limit_found(record, path, "place of the worst sticker"),
        "mesh_deg": float(np.linalg.norm([u[name] for name in turn])),
    }
    return Said(figures, ("mesh to robot",))


def _of_camera(record: Record, path: Path) -> Said:
    lens, _ = intrinsics_of(record)
    distance_mm = record.validity.focus_distance_mm or WORKING_MM
    px = _limit_found(record, path, "uncertainty at the field's corners")
    return Said({"lens_px": px, "pixel_mm": distance_mm / lens.fx}, ("lens",))


def _of_hand_eye(record: Record, path: Path) -> Said:
    """Use lens and hand-eye together, because their errors partly cancel, and the robot's noise at one pose."""
    lens, _ = intrinsics_of(record)
    distance_mm = record.validity.focus_distance_mm or WORKING_MM
    noise = {line.name: line.found for line in record.noise}
    turned_mm = np.radians(noise["robot orientation"]) * (distance_mm + camera_reach_mm(record))
    pose_mm = float(np.sqrt(2.0 * (noise["robot position"] ** 2 + turned_mm**2)))
    figures = {
        "camera_mm": float(np.hypot(ray_mm(record, distance_mm), pose_mm)),
        "lens_px": 0.0,
        "pixel_mm": distance_mm / lens.fx,
    }
    return Said(figures, ("camera", "lens"))


def reader_of(kind: Kind) -> Callable[[Record, Path], Said] | None:
    """Return the function that reads a record of this kind for a budget; None if a budget does not use this
    kind."""
    match kind:
        case "camera":
            return _of_camera
        case "hand-eye":
            return _of_hand_eye
        case "leds":
            return _of_leds
        case "mesh":
            return _of_mesh
        case "flat-field":
            return _of_flat_field
        case "response":
            return _of_response
        case "led-power":
            return _of_led_power
        case "drift":
            return _of_drift
        case "glare":
            return _of_glare
        case "chromatic" | "dark" | "colour" | "artefact-check":
            return None
        case _:
            assert_never(kind)


_KINDS = ", ".join(kind for kind in get_args(Kind) if reader_of(kind))
"""Kinds of records that a budget uses, for messages."""


def camera_reach_mm(record: Record) -> float:
    """Return the distance from the middle of the flange to the middle of the camera."""
    return float(np.linalg.norm(record.transforms[_SEEN_FROM_HAND_EYE].translation_mm))


def ray_mm(record: Record, distance_mm: float) -> float:
    """Return the standard uncertainty of the point where a ray meets an object at this distance. It is the
    uncertainty across the ray, both directions together, as root mean square over the field. It follows from the
    common covariance of lens and hand-eye. The zeros of the arm's axes are left out, because a record has no
    posture. With them the uncertainty falls by up to half (the zero of the last axis is correlated with a rotation
    of the camera).

    A step of flange_from_camera by t (flange's axes) and r (camera's axes) moves a point p of the camera frame by
    -(R^T t + r x p).
    """
    lens, free = intrinsics_of(record)
    names = [parameter.name for parameter in record.parameters]
    needed_names = [n for n in names if n.removesuffix("_px") in free] + list(step_names(_SEEN_FROM_HAND_EYE))
    at = [names.index(name) for name in needed_names]
    covariance = record.covariance_matrix[np.ix_(at, at)]
    half = np.array(record.validity.size_px or (2 * lens.cx, 2 * lens.cy)) / 2.0
    points = distance_mm * np.column_stack([_FIELD * half / (lens.fx, lens.fy), np.ones(len(_FIELD))])
    projection = optics.project(points, lens.vector())
    turn = record.transforms[_SEEN_FROM_HAND_EYE].matrix()[:3, :3]
    by_step = np.concatenate(
        [np.broadcast_to(-turn.T, (len(points), 3, 3)), np.radians(skew(points))], axis=2
    )  # -(r x p) = p x r
    by_lens = projection.by_intrinsics[:, :, [optics.NAMES.index(name) for name in free]]
    slopes: Floats = np.concatenate([by_lens, projection.by_point @ by_step], axis=2)
    variance_px2 = np.einsum("kia,ab,kib->k", slopes, covariance, slopes)
    return float(np.sqrt(variance_px2.mean()) * distance_mm / lens.fx)


def _limit_found(record: Record, path: Path, words: str) -> float:
    for limit in record.limits:
        if limit.what.startswith(words):
            return limit.found
    raise InputError(f"{path}: expected a limit that begins with `{words}` in a record of `{record.kind}`")
