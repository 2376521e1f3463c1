"""Makes the record of the LEDs' power from frames of a white tile."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from coupole.calibration.acceptance import against_limits
from coupole.calibration.earlier import GLARE, READ_WITH
from coupole.calibration.light import drawing as pictures
from coupole.calibration.light.acceptance import LED_POWER
from coupole.calibration.light.frames import LightFrame, LightFrames, channels_of
from coupole.calibration.light.led_power import LEAST_PRIOR, LedPower, calibrate_led_power, prior_of
from coupole.calibration.light.led_power_tile import Setting, TileReader
from coupole.calibration.light.radiometric_record import Findings, sealed_outcome
from coupole.calibration.light.records import Progress, counter
from coupole.calibration.light.tile_views import TileView, list_of
from coupole.calibration.record import Limit, Parameter
from coupole.calibration.report import Outcome
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats
from coupole.errors import InputError


def led_power_outcome(frames: LightFrames, setting: Setting, request: Request, progress: Progress) -> Outcome:
    """Find the power of each LED per channel, from the tile's views. Raises InputError like
    `calibrate_led_power`."""
    lit = [frame for frame in frames.lit if frame.led is not None]
    if not lit:
        raise InputError("LED power: no frame under an LED; acquire `coupole plan new spectralon`")
    channels = channels_of(frames.pattern)
    by_view: dict[tuple[str, float], list[LightFrame]] = {}
    for frame in lit:
        by_view.setdefault((frame.view, frame.exposure_us), []).append(frame)
    reader = TileReader(frames, setting, lit[0].read().shape)
    views: dict[str, list[TileView]] = {channel: [] for channel in channels}
    tell = counter(progress, len(lit))
    for view_frames in by_view.values():
        for channel, view in reader.view(view_frames, tell).items():
            views[channel].append(view)
    powers = {
        channel: calibrate_led_power(
            views[channel], setting.positions, setting.tile_of(channel), emission=setting.emission
        )
        for channel in channels
    }
    powers = with_equal_figures(powers)
    warm = board_temperatures(lit)
    covariance = covariance_of(powers, {channel: prior_of(setting.tile_of(channel)) for channel in channels})
    parameters = _parameters(powers, covariance)
    height, width = reader.shape
    other_ids = np.setdiff1d(setting.positions.ids, powers["G"].ids)
    remarks = [f"{len(other_ids)} LEDs of the dome have no frame: {list_of(other_ids)}"] if len(other_ids) else []
    remarks += list(dict.fromkeys(remark for power in powers.values() for remark in power.remarks))
    limits = power_limits(powers, request.limits)
    remarks += _of_views(powers["G"], limits)
    return sealed_outcome(
        "led-power",
        request,
        frames,
        (width, height),
        Findings(
            parameters,
            covariance,
            limits=limits,
            files={f"{request.name}.csv": power_table(powers, warm).encode()},
            fixed_figures={
                "tile.reflectance": setting.tile_of("G").reflectance,
                "tile.minnaert": setting.tile.minnaert,
                "gain_db": frames.gain_db,
                READ_WITH + "response": float(setting.response is not None),
                READ_WITH + "flat-field": float(setting.flat is not None),
                **({} if setting.glare is None else {READ_WITH + GLARE: 1.0}),
            },
            remarks=(f"emission profile `{setting.emission}`", *remarks),
            more_inputs=setting.inputs,
            artefacts=setting.artefacts(channels),
        ),
        partial(pictures.draw_led_power, powers, setting.positions),
    )


def power_limits(powers: Mapping[str, LedPower], operator_limits: Mapping[str, float]) -> tuple[Limit, ...]:
    """Compare the powers with their limits: the powers of green, and the worst channel's causes."""
    green = powers["G"]
    good = np.isfinite(green.power) & (green.power > 0)
    u = green.u_against_mean()
    figures = {
        "power": float(np.median(u[good])),
        "unusable": float(np.mean(~np.isfinite(green.power))),
        "left_out": green.left_out.ratio(np.where(good, u, np.nan)),
        "scatter": green.noise,
        "lobe": max(abs(power.causes.gloss) for power in powers.values()),
        "stain": max(abs(power.parts.loss) + power.parts.u_loss for power in powers.values()),
        "drift": max(power.causes.drift for power in powers.values()),
        "unsteady": max(power.causes.unsteady for power in powers.values()),
    }
    return against_limits(LED_POWER, operator_limits, figures)


def _of_views(power: LedPower, limits: Sequence[Limit]) -> list[str]:
    """Return a sentence on the effect of leaving each view out, and advice if views contradict each other."""
    figures = {limit.name: limit for limit in limits}
    if not power.left_out.worst:
        return ["each LED is in one view only, so a drift, or a lobe of the tile, cannot be detected"]
    line = (
        f"views left out in turn move the powers by {figures['left_out'].found:.2f} times the stated uncertainty; "
        f"{power.left_out.worst} moves them most"
    )
    if figures["left_out"].is_met and figures["scatter"].is_met:
        return [line]
    return [
        f"{line}. Views contradict each other by more than noise, and the named causes do not explain it. Look "
        f"for "
        "a tile, camera or lamp that moved between the views; then take the views anew"
    ]


def with_equal_figures(powers: Mapping[str, LedPower]) -> dict[str, LedPower]:
    """Return the powers with the same number of figures of causes in each channel; added figures change
    nothing."""
    most = max(powers.values(), key=lambda power: len(power.common_names)).common_names
    equal = {}
    for channel, power in powers.items():
        more = len(most) - len(power.common_names)
        equal[channel] = replace(
            power,
            common=np.pad(power.common, ((0, 0), (0, more))),
            common_names=most,
            common_covariance=np.asarray(block_diag(power.common_covariance, np.eye(more))),
            departures=np.pad(power.departures, (0, more)),
        )
    return equal


def board_temperatures(lit: Sequence[LightFrame]) -> dict[int, float]:
    """Return the mean temperature of each LED's board over its frames, C; NaN if it is not known. The LED's power
    holds for this temperature."""
    temperatures_c: dict[int, list[float]] = {}
    for frame in lit:
        assert frame.led is not None, "only frames under LEDs are read"
        temperatures_c.setdefault(frame.led, []).append(frame.temperature_c)
    return {led: float(np.mean(celsius)) for led, celsius in temperatures_c.items()}


def power_table(powers: Mapping[str, LedPower], board_c: Mapping[int, float]) -> str:
    """Return CSV with, for each LED, its board temperature, its power by channel, its own uncertainty, and its
    derivative by each common figure.

    The covariance of two LEDs' relative powers is the covariance of the common figures, multiplied by their
    derivatives from both sides. On the diagonal u_own^2 is added.
    """
    first = next(iter(powers.values()))
    text = io.StringIO()
    columns = ["id", "board_c"]
    for channel in powers:
        columns += [f"power_{channel}", f"u_own_{channel}", f"u_{channel}"]
        columns += [f"d_{name}_{channel}" for name in first.common_names]
    text.write("# power in DN s^-1 m^2 sr, uncertainties relative; 0: dead, nan: no usable picture\n")
    text.write(",".join(columns) + "\n")
    for n, led in enumerate(first.ids):
        row = [f"{led}", f"{board_c[int(led)]:.2f}"]
        for power in powers.values():
            row += [f"{power.power[n]:.9g}", f"{power.u_own[n]:.4g}", f"{power.u()[n]:.4g}"]
            row += [f"{value:.5g}" for value in power.common[n]]
        text.write(",".join(row) + "\n")
    return text.getvalue()


def _parameters(powers: Mapping[str, LedPower], covariance: Floats) -> list[Parameter]:
    """Return the mean power and the shared figures, by channel. The power of each LED is in the table."""
    parameters = []
    u = iter(np.sqrt(np.diag(covariance)))
    for channel, power in powers.items():
        names = ["mean_power", *power.common_names]
        values = [_mean_and_slopes(power)[0], *power.departures]
        parameters += [
            Parameter(
                name=f"{name}.{channel}",
                value=float(value),
                u=float(next(u)),
                degrees_of_freedom=power.degrees_of_freedom,
                dominated_by="the tile's description",
            )
            for name, value in zip(names, values, strict=True)
        ]
    return parameters


def _mean_and_slopes(power: LedPower) -> tuple[float, Floats]:
    """Return the mean power of all LEDs, and its derivatives [c] with respect to the shared figures."""
    good = np.isfinite(power.power) & (power.power > 0)
    return float(power.power[good].mean()), np.asarray((power.power[good, None] * power.common[good]).mean(axis=0))


def covariance_of(powers: Mapping[str, LedPower], priors: Mapping[str, Floats]) -> Floats:
    """Return the covariance of `_parameters`, [channels (1 + c)] squared.

    All channels see the same tile. So errors of their priors are fully correlated, even if a certificate's
    spectrum gives each channel its own prior. Let the priors have the standard uncertainties s_a, s_b and the
    posteriors C_a, C_b. Then the errors of channels a and b have the covariance C_a diag(1 / (s_a s_b)) C_b, which
    is the remaining part of the priors' error. Their noise is independent.
    """
    powers = with_equal_figures(powers)
    of_tile = len(next(iter(priors.values())))
    size = 1 + len(next(iter(powers.values())).common_names)
    whole = np.zeros((size * len(powers), size * len(powers)))
    sigmas = [np.maximum(priors[channel], LEAST_PRIOR) for channel in powers]
    by_common = [np.vstack([_mean_and_slopes(power)[1], np.eye(size - 1)]) for power in powers.values()]
    for i, first in enumerate(powers.values()):
        for j, second in enumerate(powers.values()):
            between = first.common_covariance
            if i != j:
                inverse_priors = np.diag(1.0 / (sigmas[i] * sigmas[j]))
                between = between[:, :of_tile] @ inverse_priors @ second.common_covariance[:of_tile]
            block = by_common[i] @ between @ by_common[j].T
            if i == j:
                good = np.isfinite(first.power) & (first.power > 0)
                block[0, 0] += float(np.sum((first.power[good] * first.u_own[good]) ** 2)) / good.sum() ** 2
            whole[i * size : (i + 1) * size, j * size : (j + 1) * size] = block
    return whole
