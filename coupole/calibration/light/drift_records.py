"""Makes the record of a run's drift from the frames that show the reference tile."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from coupole.calibration.acceptance import against_limits
from coupole.calibration.earlier import GLARE, read_accepted, refuse_read_otherwise
from coupole.calibration.light.acceptance import DRIFT
from coupole.calibration.light.drift import NAMES, Drift, Reading, fit_drift
from coupole.calibration.light.drift_drawing import draw_drift
from coupole.calibration.light.frames import LightFrame, LightFrames
from coupole.calibration.light.led_power import prior_of
from coupole.calibration.light.led_power_tile import Setting, TileReader
from coupole.calibration.light.radiometric_record import Findings, sealed_outcome
from coupole.calibration.light.records import Progress, counter, record_input
from coupole.calibration.light.tile_views import OF_PLACE, Emitter, rows_of
from coupole.calibration.record import Parameter
from coupole.calibration.report import Outcome
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

CHANNEL = "G"
"""The channel that is used. One channel is sufficient, because an LED's power drifts, but its colour hardly
changes."""
_DARK = 0.1
"""Least share of the expected signal. A smaller signal means a shadow, or a dead LED."""
_FLASH = 5e-4
"""Relative scatter of an LED's flashes (as in `calibrate_led_power`)."""


@dataclass(frozen=True)
class Powers:
    """The powers that a record has for one channel."""

    row: dict[int, int]
    """Row of each LED in the arrays, by its id."""
    power: Floats
    u_own: Floats
    board_c: Floats
    """[n] temperature of each LED's board when its power was calibrated."""
    common: Floats
    """[n, c] relative change of each power by one unit of each figure that the LEDs share."""
    names: tuple[str, ...]
    covariance: Floats
    """[c, c]."""
    departures: dict[str, float]
    """Departure of the shared figures from their description, as the calibration found it."""


def read_powers(path: Path, channel: str = CHANNEL) -> Powers:
    """Read the table beside a record of the kind `led-power`, in one channel. Raises InputError for another kind,
    or for an older record."""
    record = read_accepted(path, "led-power")
    table = path.parent / record.files[0].name
    lines = [line for line in table.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    columns = list(csv.DictReader(lines))
    if "board_c" not in columns[0]:
        raise InputError(f"{table}: has no temperatures of boards; calibrate the LEDs' power anew")
    start, end = "d_", f"_{channel}"
    names = tuple(key[len(start) : -len(end)] for key in columns[0] if key.startswith(start) and key.endswith(end))

    def numbers(key: str) -> Floats:
        return np.array([float(line[key]) for line in columns])

    record_names = [parameter.name for parameter in record.parameters]
    at = [record_names.index(f"{name}.{channel}") for name in names]
    return Powers(
        {int(line["id"]): row for row, line in enumerate(columns)},
        numbers(f"power_{channel}"),
        numbers(f"u_own_{channel}"),
        numbers("board_c"),
        np.column_stack([numbers(f"d_{name}_{channel}") for name in names]),
        names,
        record.covariance_matrix[np.ix_(at, at)],
        {name: record.value(f"{name}.{channel}") for name in names},
    )


def drift_outcome(
    frames: LightFrames, setting: Setting, led_power: Path, request: Request, progress: Progress
) -> Outcome:
    """Find the drift of the LEDs' power from its calibration to a run, from views that show the reference tile.

    Raises InputError if no view shows the tile, and like `fit_drift`.
    """
    powers = read_powers(led_power)
    read_with = {"response": setting.response, "flat-field": setting.flat, GLARE: setting.glare}
    refuse_read_otherwise(
        led_power, read_accepted(led_power, "led-power"), [kind for kind, path in read_with.items() if path]
    )
    lit = [frame for frame in frames.lit if frame.led is not None]
    if not lit:
        raise InputError("drift: no frame under an LED in this run")
    reader = TileReader(frames, setting, lit[0].read().shape)
    views = [view_frames for view_frames in _by_view(lit) if reader.sees(view_frames[0].base_from_camera)]
    remarks: list[str] = []
    readings = _readings(views, reader, setting, powers, remarks, progress)
    dark = [reading for reading in readings if reading.ratio < _DARK]
    if dark:
        remarks.append(f"{len(dark)} readings are dark (shadow, or a dead LED), not used: {_list(dark)}")
    drift = fit_drift(
        [reading for reading in readings if reading.ratio >= _DARK],
        shared_covariance=_shared_covariance(setting, powers),
    )
    if drift.odd:
        remarks.append(f"{len(drift.odd)} readings differ from their neighbours, not used: {_list(drift.odd)}")
    warmer_k = np.array([_warmer_k(frame, powers) for frame in lit])
    t_s = np.array([frame.t_s for frame in lit])
    u = drift.u_factor(warmer_k, t_s)
    factor = drift.factor(warmer_k, t_s)
    left_out = (len(dark) + len(drift.odd)) / len(readings)
    height, width = reader.shape
    return sealed_outcome(
        "drift",
        request,
        frames,
        (width, height),
        Findings(
            _parameters(drift),
            drift.covariance,
            limits=against_limits(DRIFT, request.limits, {"factor": float(u.max()), "left_out": left_out}),
            files={f"{request.name}.csv": _table(drift).encode()},
            fixed_figures={"start_s": drift.start_s, "hours": drift.hours, "noise": drift.noise},
            remarks=(
                f"{len(drift.used_readings)} readings in {len(views)} views; factor {factor.min():.4f} to "
                f"{factor.max():.4f}",
                "ln factor = level + rate_per_h (t - start_s) / 3600 + per_k (T - board_c); T is the board's "
                "temperature, board_c its temperature in the powers' table",
                *remarks,
            ),
            more_inputs=(*record_input(led_power), *setting.inputs),
            artefacts=setting.artefacts([CHANNEL]),
        ),
        partial(draw_drift, drift, warmer_k, t_s),
    )


# -- helpers --------------------------------------------------------------------------------------------------


def _readings(
    frames_of_views: Sequence[Sequence[LightFrame]],
    tile_reader: TileReader,
    setting: Setting,
    powers: Powers,
    remarks: list[str],
    progress: Progress,
) -> list[Reading]:
    """Return readings of the tile under each LED of known power, from the frames of the views that show the tile.

    Observations that cannot be used are added to `remarks`. Raises InputError if no view shows the tile.
    """
    if not frames_of_views:
        raise InputError(
            "drift: no view shows the whole reference tile where its description puts it; correct the "
            "description, "
            "or add a view of the tile to the plan"
        )
    tile = setting.tile_of(CHANNEL)
    readings: list[Reading] = []
    frame_done = counter(progress, sum(map(len, frames_of_views)))
    for view_frames in frames_of_views:
        view = tile_reader.view(view_frames, frame_done)[CHANNEL]
        view_rows = rows_of(0, view, setting.positions, tile, Emitter(setting.emission))
        remarks += view_rows.remarks
        frame_of = {frame.led: frame for frame in view_frames if frame.led is not None}
        readings += [
            _reading(frame_of[row.led], row.value, row.u, row.design, powers)
            for row in view_rows.rows
            if powers.row.get(row.led) is not None and powers.power[powers.row[row.led]] > 0
        ]
    return readings


def _by_view(lit: Sequence[LightFrame]) -> list[list[LightFrame]]:
    """Return frames by view, exposure and repeat, with each LED once."""
    frames_of: dict[tuple[str, int, int], list[LightFrame]] = {}
    for frame in lit:
        label = frame.shot.label
        frames_of.setdefault((frame.view, label.exposure, label.repeat), []).append(frame)
    return list(frames_of.values())


def _reading(frame: LightFrame, value: float, u: float, design: Floats, powers: Powers) -> Reading:
    """Return the tile's signal under one LED relative to the LED's calibrated power. `design` is that of
    `rows_of`."""
    assert frame.led is not None, "only frames under LEDs are read"
    row = powers.row[frame.led]
    ratio, u_own = value / powers.power[row], float(powers.u_own[row])
    # Reflectance and Minnaert's k of the tile are those that the powers were calibrated with.
    ratio *= np.exp(-design[3] * powers.departures["ln_reflectance"] - design[4] * powers.departures["minnaert"])
    common = powers.common[row].copy()
    common[powers.names.index("ln_reflectance")] += design[3]
    common[powers.names.index("minnaert")] += design[4]
    noise = np.sqrt((u / value) ** 2 + u_own**2 + _FLASH**2) if value > 0 else 1.0
    return Reading(
        str(frame.shot),
        frame.t_s,
        _warmer_k(frame, powers),
        float(ratio),
        float(abs(ratio) * noise),
        tuple(map(float, (*design[:3], *common))),
    )


def _shared_covariance(setting: Setting, powers: Powers) -> Floats:
    """Return the covariance of the tile's tilt and height in this run, then of the figures that the powers'
    calibration shared."""
    from scipy.linalg import block_diag

    place = np.diag(prior_of(setting.tile)[:OF_PLACE] ** 2)
    return np.asarray(block_diag(place, powers.covariance))


def _warmer_k(frame: LightFrame, powers: Powers) -> float:
    row = powers.row.get(frame.led) if frame.led is not None else None
    return float("nan") if row is None else frame.temperature_c - float(powers.board_c[row])


def _parameters(drift: Drift) -> list[Parameter]:
    u = np.sqrt(np.diag(drift.covariance))
    by = ("readings of the tile, its tilt", "prior of 0.5 % per hour", "prior of white LEDs, readings")
    return [
        Parameter(
            name=name, value=float(value), u=float(sigma), degrees_of_freedom=drift.freedom, dominated_by=why
        )
        for name, value, sigma, why in zip(NAMES, drift.parameters, u, by, strict=True)
    ]


def _table(drift: Drift) -> str:
    """Return the readings as CSV."""
    text = io.StringIO()
    text.write(
        "# the reference tile: signal divided by the signal expected from the calibrated power; residual of the "
        "fit\n"
    )
    text.write("shot,t_s,warmer_k,ratio,u_ratio,residual\n")
    for reading, residual in zip(drift.used_readings, drift.residuals, strict=True):
        text.write(
            f"{reading.name},{reading.t_s:.6f},{reading.warmer_k:.2f},{reading.ratio:.6f},{reading.u_ratio:.2g},"
            f"{residual:.6f}\n"
        )
    return text.getvalue()


def _list(readings: Sequence[Reading]) -> str:
    names = ", ".join(reading.name for reading in readings[:5])
    return names + (f" and {len(readings) - 5} more" if len(readings) > 5 else "")
