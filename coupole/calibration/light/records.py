"""Makes the records of dark frames and response; has functions for all radiometric records.

Each calibration returns an `Outcome`: a sealed record, its maps or tables, its picture.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.acceptance import against_limits
from coupole.calibration.earlier import read_accepted, read_earlier
from coupole.calibration.light import drawing as pictures
from coupole.calibration.light.acceptance import DARK, RESPONSE
from coupole.calibration.light.dark import Dark, DarkFrame, calibrate_dark, warmth_of
from coupole.calibration.light.frames import (
    LightFrame,
    LightFrames,
    channel_mask,
    channels_of,
)
from coupole.calibration.light.linearity import Linearity, linearity
from coupole.calibration.light.pairs import Pair
from coupole.calibration.light.photon_transfer import PhotonTransfer, photon_transfer
from coupole.calibration.light.radiometric_record import Findings, sealed_outcome
from coupole.calibration.record import (
    Kind,
    Limit,
    Noise,
    Parameter,
)
from coupole.calibration.report import Outcome
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats
from coupole.errors import InputError
from coupole.plan.shot_id import Light

Progress = Callable[[int, int], None]
_MOST_PIXELS = 200_000
"""Greatest number of pixels of a channel that are used for the response."""


# -- dark -----------------------------------------------------------------------------------------------------


def dark_outcome(frames: LightFrames, request: Request, progress: Progress) -> Outcome:
    """Find maps of offset and current, noise, and hot pixels from dark frames of runs."""
    if not frames.dark:
        raise InputError("dark: no dark frame in these runs; acquire `coupole plan new darks`")
    dark_frames = [DarkFrame(str(f.shot), f.exposure_us * 1e-6, f.temperature_c, f.read) for f in frames.dark]
    dark = calibrate_dark(dark_frames, white_dn=frames.white_dn, progress=progress)
    height, width = dark.offset_dn.shape
    values = {
        "read_noise_dn": (dark.read_noise_dn, dark.read_noise_u_dn),
        "row_noise_dn": (dark.row_noise_dn, dark.row_noise_u_dn),
        "offset_dn": _mean_and_u(dark.offset_dn, dark.noise_dn * np.sqrt(dark.cofactor[0, 0]), dark.hot),
        "current_dn_per_s": _mean_and_u(
            dark.current_dn_per_s, dark.noise_dn * np.sqrt(dark.cofactor[1, 1]), dark.hot
        ),
    }
    parameters = [
        Parameter(
            name=name, value=value, u=u, degrees_of_freedom=dark.degrees_of_freedom, dominated_by="read noise"
        )
        for name, (value, u) in values.items()
    ]
    fixed_figures = {"doubling_k": dark.doubling_k, "offset_spread_dn": float(np.std(dark.offset_dn))}
    fixed_figures |= {} if dark.reference_c is None else {"reference_c": dark.reference_c}
    fixed_figures |= {f"cofactor.{i}{j}": float(dark.cofactor[i, j]) for i, j in ((0, 0), (0, 1), (1, 1))}
    fixed_figures["map_degrees_of_freedom"] = float(dark.degrees_of_freedom)
    content = h5_of(
        {
            "offset_dn": dark.offset_dn,
            "current_dn_per_s": dark.current_dn_per_s,
            "noise_dn": dark.noise_dn,
            "hot_row_column": dark.hot,
        }
    )
    return sealed_outcome(
        "dark",
        request,
        frames,
        (width, height),
        Findings(
            parameters,
            _of_means(dark, np.array([p.u for p in parameters])),
            limits=against_limits(DARK, request.limits, {"hot": len(dark.hot) / dark.offset_dn.size}),
            files={f"{request.name}.h5": content},
            fixed_figures=fixed_figures,
            remarks=(f"{len(dark.hot)} hot pixels of {height * width}; the list is in {request.name}.h5",),
        ),
        partial(pictures.draw_dark, dark),
    )


def _of_means(dark: Dark, u: Floats) -> Floats:
    """Return [4, 4], the covariance of the two noises, which are independent, and of mean offset and mean current,
    which the line correlates."""
    covariance = np.diag(u**2)
    together = float(dark.cofactor[0, 1] / np.sqrt(dark.cofactor[0, 0] * dark.cofactor[1, 1]))
    covariance[2, 3] = covariance[3, 2] = together * u[2] * u[3]
    return covariance


def dark_signal(frames: LightFrames, record_path: Path | None) -> Callable[[LightFrame], NDArray[np.float32]]:
    """Return a function for the dark signal [H, W], DN: from a dark record, else from dark frames of the same
    exposure, else from the camera's black level."""
    if record_path is not None:
        offset = map_beside(record_path, "dark", "offset_dn", frames)
        current = map_beside(record_path, "dark", "current_dn_per_s", frames)
        record = read_accepted(record_path, "dark")
        warm, reference_c = frames.temperature_range_c, record.fixed.get("reference_c")
        # LED boards are warmed by their own light: the coolest has nearly the temperature of the camera.
        warmth = 1.0 if warm is None else warmth_of(warm[0], reference_c, record.value("doubling_k"))
        return lambda frame: offset + current * np.float32(warmth * frame.exposure_us * 1e-6)
    dark_of_exposure: dict[float, NDArray[np.float32]] = {}

    def of_frames(frame: LightFrame) -> NDArray[np.float32]:
        exposure_us = frame.exposure_us
        if exposure_us not in dark_of_exposure:
            alike = [f for f in frames.dark if f.exposure_us == exposure_us]
            if not alike:
                return np.full(frame.read().shape, frames.black_dn, np.float32)
            dark_of_exposure[exposure_us] = mean_of(alike)
        return dark_of_exposure[exposure_us]

    return of_frames


def map_beside(path: Path, kind: Kind, name: str, frames: LightFrames) -> NDArray[np.float32]:
    """Return a map [H, W] beside a record for these frames. Raises InputError."""
    record = read_earlier(path, kind, frames.about, frames.size_px)
    with h5py.File(path.parent / record.files[0].name, "r") as file:
        values: NDArray[np.float32] = file[name][()]
        return values


def _mean_and_u(
    values: NDArray[np.float32], u: NDArray[np.float32], hot: NDArray[np.int64]
) -> tuple[float, float]:
    """Return mean and standard uncertainty of a map without hot pixels. Errors of pixels are independent."""
    cold = np.ones(values.shape, np.bool_)
    cold[hot[:, 0], hot[:, 1]] = False
    variance = np.mean(np.square(u[cold], dtype=np.float64))
    return float(values[cold].mean(dtype=np.float64)), float(np.sqrt(variance / cold.sum()))


# -- response -------------------------------------------------------------------------------------------------


def response_outcome(
    frames: LightFrames, request: Request, dark_record: Path | None, progress: Progress
) -> Outcome:
    """Find gain, noise and linearity from bracketed exposures of a constant scene, each taken twice."""
    lit = _one_scene(frames)
    by_exposure: dict[float, list[LightFrame]] = {}
    for frame in lit:
        by_exposure.setdefault(frame.exposure_us, []).append(frame)
    single = [exposure_us for exposure_us, group in by_exposure.items() if len(group) < 2]
    if single:
        raise InputError(
            f"response: expected two frames of each exposure, found one of {single[0]:.0f} us; set `repeats: 2`"
        )
    pairs = _pairs_by_channel(frames, by_exposure, dark_signal(frames, dark_record), progress)
    range_dn = float(frames.white_dn - frames.black_dn)
    transfers = {channel: photon_transfer(group) for channel, group in pairs.items()}
    lines = {channel: linearity(group, range_dn) for channel, group in pairs.items()}
    height, width = lit[0].read().shape
    parameters, covariance = _response_parameters(transfers, lines)
    worst = max(line.u_deviation for line in lines.values())
    flicker = max(line.flicker for line in lines.values())
    remarks = [_linear_remark(channel, line) for channel, line in lines.items()]
    if not any(t.saturated_seen for t in transfers.values()):
        remarks.append("no frame was saturated: the full well is a lower bound")
    noise = [
        Noise(
            name=f"reading {channel}",
            unit="e",
            stated=0.0,
            found=transfer.read_noise_e.value,
            redundancy=float(transfer.used_levels.sum() - 2),
        )
        for channel, transfer in transfers.items()
    ]
    return sealed_outcome(
        "response",
        request,
        frames,
        (width, height),
        Findings(
            parameters,
            covariance,
            limits=against_limits(RESPONSE, request.limits, {"linearity": worst, "flicker": flicker}),
            noise=noise,
            fixed_figures={"range_dn": range_dn, **_saturation_figures(transfers)},
            remarks=remarks,
            more_inputs=record_input(dark_record),
        ),
        partial(pictures.draw_response, transfers, lines),
    )


def _pairs_by_channel(
    frames: LightFrames,
    by_exposure: Mapping[float, Sequence[LightFrame]],
    dark: Callable[[LightFrame], NDArray[np.float32]],
    progress: Progress,
) -> dict[str, list[Pair]]:
    """Return the first two frames of each exposure, without the dark signal."""
    channels = channels_of(frames.pattern)
    pairs: dict[str, list[Pair]] = {channel: [] for channel in channels}
    for number, (exposure_us, exposure_frames) in enumerate(sorted(by_exposure.items())):
        black = dark(exposure_frames[0])
        first, second = (frame.read() for frame in exposure_frames[:2])
        for channel in channels:
            take = _sample(first.shape, frames.pattern, channel)
            raw_a, raw_b, under = first[take], second[take], black[take]
            full = np.maximum(raw_a, raw_b) >= frames.white_dn
            a, b = (np.subtract(raw, under, dtype=np.float64) for raw in (raw_a, raw_b))
            pairs[channel].append(Pair(str(exposure_frames[0].shot), exposure_us, a, b, full))
        progress(number + 1, len(by_exposure))
    return pairs


def _saturation_figures(transfers: Mapping[str, PhotonTransfer]) -> dict[str, float]:
    figures = {}
    for channel, transfer in transfers.items():
        figures[f"saturation_dn.{channel}"] = transfer.saturation_dn
        figures[f"saturation_e.{channel}"] = transfer.saturation_e.value
        if transfer.prnu is not None:
            figures[f"prnu.{channel}"] = transfer.prnu.value
    return figures


def _one_scene(frames: LightFrames) -> list[LightFrame]:
    """Return the frames of one view under one light: those with the most frames."""
    if not frames.lit:
        raise InputError("response: no frame with light; acquire `coupole plan new response`")
    frames_of: dict[tuple[str, Light], list[LightFrame]] = {}
    for frame in frames.lit:
        frames_of.setdefault((frame.view, frame.shot.light), []).append(frame)
    return max(frames_of.values(), key=len)


def _sample(shape: tuple[int, ...], pattern: str, channel: str) -> NDArray[np.bool_]:
    """Return a mask [H, W] of a sample of a channel's pixels in whole rows. Neighbours stay neighbours."""
    mask = channel_mask((shape[0], shape[1]), pattern, channel)
    step = max(1, round(float(mask.sum()) / _MOST_PIXELS))
    rows = (np.arange(shape[0]) // 2) % step == 0
    return np.asarray(mask & rows[:, None])


def _response_parameters(
    transfers: Mapping[str, PhotonTransfer], lines: Mapping[str, Linearity]
) -> tuple[list[Parameter], Floats]:
    parameters: list[Parameter] = []
    blocks: list[Floats] = []
    for channel, transfer in transfers.items():
        line = lines[channel]
        gain = transfer.gain_dn_per_e
        intercept = transfer.read_noise_dn.value**2 + 1.0 / 12.0
        freedom = float(max(1, transfer.used_levels.sum() - 2))
        values = [
            ("dark_variance_dn2", intercept, float(np.sqrt(transfer.covariance[0, 0])), "read noise"),
            ("gain_dn_per_e", gain.value, gain.u, "shot noise"),
            ("c2", float(line.coefficients[0]), float(np.sqrt(line.covariance[0, 0])), "flicker"),
            ("c3", float(line.coefficients[1]), float(np.sqrt(line.covariance[1, 1])), "flicker"),
            ("time_offset_us", line.time_offset_us.value, line.time_offset_us.u, "shortest exposures"),
        ]
        parameters += [
            Parameter(name=f"{name}.{channel}", value=value, u=u, degrees_of_freedom=freedom, dominated_by=by)
            for name, value, u, by in values
        ]
        offset = np.array([[line.time_offset_us.u**2]])
        curve = np.block([[line.covariance, line.with_offset[:, None]], [line.with_offset[None], offset]])
        blocks += [transfer.covariance, curve]
    return parameters, block_diagonal(blocks)


def _linear_remark(channel: str, line: Linearity) -> str:
    how = "corrected by a polynomial" if line.coefficients.any() else "which is not significant"
    off = f"{line.worst_deviation:.2%} ({line.u_deviation:.2%})"
    return f"{channel}: deviates from a straight line by {off}, {how}"


def linearise(record_path: Path | None, channel: str, frames: LightFrames) -> Callable[[Floats], Floats]:
    """Return a function from signal above dark to linear signal, by a record of the kind `response`, if any.

    Raises InputError for a record of another kind, camera or sensor's pattern.
    """
    if record_path is None:
        return lambda signal: signal
    record = read_earlier(record_path, "response", frames.about, frames.size_px)
    if f"c2.{channel}" not in {parameter.name for parameter in record.parameters}:
        raise InputError(
            f"{record_path}: has no response for the channel {channel}; make a record with this camera"
        )
    c2, c3 = record.value(f"c2.{channel}"), record.value(f"c3.{channel}")
    range_dn = record.value("range_dn")

    def straight(signal: Floats) -> Floats:
        x = signal / range_dn
        return signal * (1.0 + x * (c2 + x * c3))

    return straight


# -- helpers --------------------------------------------------------------------------------------------------


def mean_of(frames: Sequence[LightFrame]) -> NDArray[np.float32]:
    """Return the mean [H, W] of frames, which are read one after the other."""
    total: NDArray[np.float32] | None = None
    for frame in frames:
        pixels = frame.read()
        total = pixels.astype(np.float32) if total is None else total + pixels
    assert total is not None
    return total / np.float32(len(frames))


def counter(progress: Progress, total: int) -> Callable[[], None]:
    """Return a function that advances a progress bar by one of `total`."""
    numbers = count(1)
    return lambda: progress(next(numbers), total)


def h5_of(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return an HDF5 file of these arrays. Large arrays are compressed."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, values in arrays.items():
            large = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if values.size > 4096 else {}
            file.create_dataset(name, data=values, track_times=False, **large)
    return buffer.getvalue()


def block_diagonal(blocks: Sequence[Floats]) -> Floats:
    """Return the covariance of groups of parameters that are independent of each other."""
    from scipy.linalg import block_diag

    return np.asarray(block_diag(*blocks))


def limit_of(description: str, figure: float, limit: float, unit: str = "") -> Limit:
    """Return a figure with its acceptance limit."""
    return Limit(what=description, found=figure, limit=limit, unit=unit)


def record_input(path: Path | None) -> tuple[tuple[str, str], ...]:
    """Return name and SHA-256 of a file that a calibration used; empty for None."""
    return () if path is None else ((path.name, hashlib.sha256(path.read_bytes()).hexdigest()),)
