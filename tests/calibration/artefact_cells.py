"""Drawn cells with two boards and two tiles: one of each calibrates the cell, the other one checks it.

Corners and signals are drawn by code of the tests' own (`synthesis`, `tile_synthesis`): lens, arm, boards that are
not what their certificates say within the stated uncertainties, rooms that are warmer, tiles that lie otherwise
than described.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np
from light_synthesis import Array
from synthesis import TrueLens, board_points, frame, looking_at_board
from tile_synthesis import dome, powers, views_of

from coupole.calibration.artefact import Artefact, Certificate, CertifiedValue, temperature_of
from coupole.calibration.check.board_lengths import Noise, Position, lengths_of
from coupole.calibration.check.tile_reflectance import Place, reflectance_of
from coupole.calibration.check.workflow import Checked, compare_lengths, compare_reflectances
from coupole.calibration.lens.board import Board, Sighting
from coupole.calibration.lens.bundle import RobotNoise
from coupole.calibration.lens.images import Found
from coupole.calibration.lens.workflow import CameraArm, hand_eye_from
from coupole.calibration.light.drift_records import Powers
from coupole.calibration.light.led_power import LedPower, calibrate_led_power, prior_of
from coupole.calibration.light.led_power_records import covariance_of
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_views import LAMBERTIAN, Positions, Row, rows_of
from coupole.calibration.posed_camera import read_posed_camera
from coupole.calibration.poses import kuka_poses
from coupole.calibration.record import read_record, write_record
from coupole.calibration.request import Request
from coupole.calibration.sources import About, Source, Sources

SIZE_PX = (4096, 3072)
PIXEL_PX, ROBOT_MM, ROBOT_DEG = 0.03, 0.03, 0.003
U_ROOM_K = 0.5
CERTIFICATE = Certificate(number="drawn", laboratory="nobody's", date=datetime.date(2026, 1, 5))
CHANNELS = "RGB"
NOW = datetime.datetime(2026, 3, 1, tzinfo=UTC)


def board_artefact(serial: str) -> Artefact:
    """A board of glass or ceramics: 12.5 ppm, 7.5 ppm/K, corners within 2 um."""
    return Artefact(
        name="board",
        serial=serial,
        certificate=CERTIFICATE,
        expansion_ppm_per_k=CertifiedValue(value=7.5, expanded_u=1.0, k=2),
        square_mm=CertifiedValue(value=16.0, expanded_u=0.0004, k=2),
        corner_um=CertifiedValue(value=0.0, expanded_u=2.0, k=2),
        flatness_um=CertifiedValue(value=10.0, expanded_u=4.0, k=2),
    )


def printed(artefact: Artefact) -> Board:
    return Board(kind="charuco", corners=(11, 8), square_mm=16.0, marker_mm=10.0, artefact=artefact)


@dataclass(frozen=True)
class CheckCell:
    """A cell: lens and hand-eye."""

    lens: TrueLens
    flange_from_camera: Array
    room_c: float


def check_cell(random: np.random.Generator) -> CheckCell:
    width, height = SIZE_PX
    focal = 35.0 / 5.5e-3 * random.uniform(1.1, 1.15)
    bent = random.normal(0, 1, 5) * (0.08, 0.1, 1e-3, 1e-3, 0.1)
    lens = TrueLens(
        (focal, focal * random.uniform(0.999, 1.001)),
        (width / 2 + random.normal(0, 30), height / 2 + random.normal(0, 30)),
        tuple(bent),  # type: ignore[arg-type]
    )
    pose = frame(random.uniform(-80, 80, 3), random.uniform(-70, 70, 3))
    return CheckCell(lens, pose, float(random.uniform(17.0, 27.0)))


def true_corners(random: np.random.Generator, artefact: Artefact, room_c: float, wrong_ppm: float = 0.0) -> Array:
    """Corners of a board as it is at a room's temperature, within what its certificate states; `wrong_ppm` is an
    error of the certificate."""
    square, expansion, corner = artefact.square_mm, artefact.expansion_ppm_per_k, artefact.corner_um
    assert square is not None
    assert expansion is not None
    assert corner is not None
    side = square.value + square.u * random.standard_normal()
    per_k = 1e-6 * (expansion.value + expansion.u * random.standard_normal())
    points = board_points(square_mm=side * (1.0 + 1e-6 * wrong_ppm) * (1.0 + per_k * (room_c - 20.0)))
    points[:, :2] += 1e-3 * corner.u * random.standard_normal((len(points), 2))
    return points


def seen_board(
    random: np.random.Generator, cell: CheckCell, points: Array, board: Board, views: int
) -> tuple[tuple[Sighting, ...], Array]:
    """A board somewhere on the support, in views from all sides: sightings, and reported poses of the flange."""
    base_from_board = frame(random.uniform(-200, 200, 3) + np.array([600, 0, 0]), random.uniform(-20, 20, 3))
    nominal, (width, height) = board.points_mm, SIZE_PX
    sightings: list[Sighting] = []
    reported = []
    while len(sightings) < views:
        board_from_camera = looking_at_board(random, points.max(axis=0)[:2], 335.0)
        seen = cell.lens.see((points - board_from_camera[:3, 3]) @ board_from_camera[:3, :3])
        inside = np.all((seen > 4) & (seen < (width - 4, height - 4)), axis=1)
        if inside.sum() < 40:
            continue
        true_flange = base_from_board @ board_from_camera @ np.linalg.inv(cell.flange_from_camera)
        error = frame(random.normal(0, ROBOT_MM, 3), random.normal(0, ROBOT_DEG, 3))
        reported.append(true_flange @ np.linalg.inv(error))
        noisy = seen + random.normal(0, PIXEL_PX, seen.shape)
        ids = np.flatnonzero(inside)
        sightings.append(Sighting(f"{len(sightings)}", ids, nominal[ids], noisy[ids]))
    return tuple(sightings), np.stack(reported)


def calibrated(random: np.random.Generator, cell: CheckCell, folder: Path, views: int = 40) -> Path:
    """The hand-eye record of a cell by its own board, in a room whose temperature was measured."""
    artefact = board_artefact("first")
    measured_c = cell.room_c + U_ROOM_K * random.standard_normal()
    board, used = printed(artefact).measured_at(temperature_of(measured_c, U_ROOM_K, None))
    points = true_corners(random, artefact, cell.room_c)
    sightings, poses = seen_board(random, cell, points, board, views)
    images = tuple(Source(sighting.name, _no_picture) for sighting in sightings)
    sources = Sources(images, kuka_poses(poses), About(is_simulated=True), (("drawn", "0" * 64),), used)
    found = Found(sightings, np.arange(len(sightings)), SIZE_PX, ())
    robot = RobotNoise(ROBOT_MM, ROBOT_DEG, 0.0, 1e-5)
    shown = hand_eye_from(found, sources, board, "brown5", Request("hand-eye", NOW), arm=CameraArm(robot))[2]
    path = folder / "hand-eye.yaml"
    write_record(path, shown.record)
    return path


def _no_picture() -> Any:
    raise AssertionError("drawn corners have no picture")


def board_checks(
    seed: int, folder: Path, *, positions: int = 5, views: int = 16, wrong_ppm: Sequence[float] = (0.0,)
) -> list[Checked]:
    """A drawn cell that is calibrated with one board and measures others: one for each error of a certificate."""
    random = np.random.default_rng([seed, 34])
    cell = check_cell(random)
    path = calibrated(random, cell, folder)
    artefact = board_artefact("second")
    measured_c = cell.room_c + U_ROOM_K * random.standard_normal()
    board, _ = printed(artefact).measured_at(temperature_of(measured_c, U_ROOM_K, None))
    camera = read_posed_camera(path, None, About(is_simulated=True), SIZE_PX)
    noise = Noise.of(read_record(path))
    checks = []
    for error_ppm in wrong_ppm:
        points = true_corners(random, artefact, cell.room_c, error_ppm)
        found = []
        for number in range(positions):
            sightings, poses = seen_board(random, cell, points, board, views)
            found.append(lengths_of(Position(f"place{number}", sightings, poses, camera), board, noise))
        checks.append(compare_lengths(found, camera.covariance, 1e-6 * board.scale_u_ppm, None))
    return checks


# -- tiles ------------------------------------------------------------------------------------------------------

DESCRIBED = Tile(reflectance=0.985, u_reflectance=0.0025, minnaert=1.12, u_minnaert=0.04, geometry="8/h")


def drawn_tile(random: np.random.Generator, wrong: float = 0.0) -> dict[str, Tile]:
    """A tile as it is, by channel, within what its certificate states; its errors are alike in all channels."""
    error, form = random.standard_normal(2)
    minnaert = DESCRIBED.minnaert + DESCRIBED.u_minnaert * form
    factors = {"R": 1.005, "G": 1.0, "B": 0.99}
    return {
        channel: DESCRIBED.model_copy(
            update={
                "reflectance": hemispherical(
                    (DESCRIBED.reflectance * factor + DESCRIBED.u_reflectance * error) * (1.0 + wrong), minnaert
                ),
                "minnaert": minnaert,
            }
        )
        for channel, factor in factors.items()
    }


def hemispherical(at_8_deg: float, minnaert: float) -> float:
    """rho of Minnaert's law by the light that comes out of the hemisphere for light at 8 degrees."""
    return at_8_deg / float(np.cos(np.radians(8.0)) ** (minnaert - 1.0))


def described_tiles() -> dict[str, Tile]:
    factors = {"R": 1.005, "G": 1.0, "B": 0.99}
    return {
        channel: DESCRIBED.model_copy(update={"reflectance": DESCRIBED.reflectance * factor})
        for channel, factor in factors.items()
    }


def tile_checks(seed: int, *, places: int = 3, leds: int = 40, wrong: Sequence[float] = (0.0,)) -> list[Checked]:
    """A drawn dome whose powers one tile calibrates, and others that they measure at some places: one for each
    error of a certificate."""
    random = np.random.default_rng([seed, 35])
    positions, described = dome(leds, random), described_tiles()
    true_powers = {channel: powers(leds, random) for channel in CHANNELS}
    first = drawn_tile(random)
    where = _lies(random)
    made: dict[str, LedPower] = {}
    for channel in CHANNELS:
        views = views_of(positions, true_powers[channel], random, truth=first[channel], **where)
        made[channel] = calibrate_led_power(views, positions, described[channel])
    known = {channel: _powers(found) for channel, found in made.items()}
    whole = covariance_of(made, {channel: prior_of(described[channel]) for channel in CHANNELS})
    size = len(known["R"].names) + 1
    at = [c * size + 1 + n for c in range(len(CHANNELS)) for n in range(size - 1)]
    checks = []
    for error in wrong:
        second = drawn_tile(random, error)
        seen = [_seen_tile(f"place{number}", random, positions, true_powers, second) for number in range(places)]
        checks.append(compare_reflectances(reflectance_of(seen, known, whole[np.ix_(at, at)])))
    return checks


def _seen_tile(
    name: str,
    random: np.random.Generator,
    positions: Positions,
    true_powers: dict[str, Array],
    tile: dict[str, Tile],
) -> Place:
    """A tile that lies somewhere, as two cameras see it."""
    described, where = described_tiles(), _lies(random)
    rows: dict[str, list[Row]] = {channel: [] for channel in CHANNELS}
    for channel in CHANNELS:
        views = views_of(positions, true_powers[channel], random, truth=tile[channel], **where)
        for v, view in enumerate(views):
            rows[channel] += rows_of(v, view, positions, described[channel], LAMBERTIAN).rows
    return Place(name, described, rows)


def _lies(random: np.random.Generator) -> dict[str, Any]:
    """A tile's tilt and height beside its description."""
    tilt = tuple(DESCRIBED.u_tilt_deg * random.standard_normal(2))
    return {"tilts_deg": (tilt,), "height_mm": DESCRIBED.u_height_mm * random.standard_normal()}


def _powers(found: LedPower) -> Powers:
    """As the table beside a record has them."""
    rows = {int(led): n for n, led in enumerate(found.ids)}
    return Powers(
        rows,
        found.power,
        found.u_own,
        np.full(len(rows), 25.0),
        found.common,
        found.common_names,
        found.common_covariance,
        dict(zip(found.common_names, map(float, found.departures), strict=True)),
    )
