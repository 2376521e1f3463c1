"""Makes the record of veiling glare from views of black traps beside white."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from coupole.calibration.acceptance import against_limits
from coupole.calibration.artefact import Described, read_described, used_as
from coupole.calibration.light.acceptance import GLARE
from coupole.calibration.light.frames import LightFrame, LightFrames, channel_mask, channels_of
from coupole.calibration.light.glare_drawing import draw_glare
from coupole.calibration.light.glare_fit import GlareFit, TrapLight, TrapView, fit_glare, trap_view
from coupole.calibration.light.glare_traps import find_traps
from coupole.calibration.light.radiometric_record import Findings, sealed_outcome
from coupole.calibration.light.records import (
    Progress,
    block_diagonal,
    dark_signal,
    linearise,
    mean_of,
    record_input,
)
from coupole.calibration.light.veil import PARTS
from coupole.calibration.record import Parameter
from coupole.calibration.report import Outcome
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats
from coupole.errors import InputError
from coupole.plan.shot_id import Light

SHARE = "share"
"""First part of the names of the shares, such as `share.even.G`."""
U_FORM = "u_form"
"""First part of the names of the relative uncertainties of a veil from its form, such as `u_form.G`."""
_MOST_SATURATED = 1e-4
"""Greatest share of saturated pixels of a frame. Their light is not known, and it causes glare."""


class GlareTarget(Described):
    """A white target with black traps, from its description."""

    schema_version: int = 1
    name: str = "black traps in a white card (not described)"
    certificate: str = ""
    """Name of the person or laboratory that measured the traps, and the date."""
    trap_share: Annotated[float, Field(ge=0, le=0.02)] = 0.0003
    """Light that leaves a trap, divided by the light of the white beside it."""
    u_trap_share: Annotated[float, Field(ge=0, le=0.02)] = 0.0002


def read_target(path: Path | None) -> GlareTarget:
    """Read the description of a target (YAML); without one, return usual figures. Raises InputError with all
    problems."""
    return GlareTarget() if path is None else read_described(path, GlareTarget)


def glare_outcome(
    frames: LightFrames,
    request: Request,
    target_path: Path | None,
    dark_record: Path | None,
    response_record: Path | None,
    progress: Progress,
) -> Outcome:
    """Find the shares of the veil's parts per channel, from views of a target. Raises InputError like
    `fit_glare`."""
    target = read_target(target_path)
    groups = _usable_frames(frames)
    dark, channels = dark_signal(frames, dark_record), channels_of(frames.pattern)
    straight = {channel: linearise(response_record, channel, frames) for channel in channels}
    width, height = frames.size_px
    masks = {channel: channel_mask((height, width), frames.pattern, channel) for channel in channels}
    views: dict[str, list[TrapView]] = {channel: [] for channel in channels}
    empty = []
    for number, ((view, light), group) in enumerate(groups.items()):
        signal = np.asarray(mean_of(group) - dark(group[0]), np.float64)
        for channel, mask in masks.items():
            signal[mask] = straight[channel](signal[mask])
        traps = find_traps(_even_brightness(signal, masks))
        for channel, mask in masks.items() if traps else ():
            views[channel].append(trap_view(f"{view}/{light}", signal.astype(np.float32), mask, traps))
        empty += [] if traps else [f"{view}/{light}: no black trap with white all around it; not used"]
        progress(number + 1, len(groups))
    trap_light = TrapLight(target.trap_share, target.u_trap_share)
    fits = {channel: fit_glare(views[channel], trap_light, channel) for channel in channels}
    return _outcome_of(fits, request, frames, target, empty, (target_path, dark_record, response_record))


def _outcome_of(
    fits: Mapping[str, GlareFit],
    request: Request,
    frames: LightFrames,
    target: GlareTarget,
    remarks: Sequence[str],
    files: Sequence[Path | None],
) -> Outcome:
    width, height = frames.size_px
    places = np.array([((width - 1) / 2, (height - 1) / 2), (0, 0), (0, (height - 1) / 2)])
    indices = {channel: fit.index(places) for channel, fit in fits.items()}
    figures = {
        "veil": max(float(u[0]) for _, u in indices.values()),
        "left_out": max(fit.off for fit in fits.values()),
        "form": max(fit.u_form for fit in fits.values()),
    }
    fixed_figures: dict[str, float] = {
        "target.trap_share": target.trap_share,
        "target.u_trap_share": target.u_trap_share,
    }
    for channel, (index, u) in indices.items():
        for place, value, u_value in zip(("middle", "corner", "side"), index, u, strict=True):
            fixed_figures |= {f"veil_{place}.{channel}": float(value), f"u_veil_{place}.{channel}": float(u_value)}
        fixed_figures[f"{U_FORM}.{channel}"] = fits[channel].u_form
    by_words = [
        f"{channel}: a black point in the middle of a white picture has {index[0]:.2%} (u {u[0]:.3%}) of the "
        f"white, at a side {index[2]:.2%}, in a corner {index[1]:.2%}"
        for channel, (index, u) in indices.items()
    ]
    words = f"target: {target.name}" + (f", {target.certificate}" if target.certificate else "")
    light = f"its traps have {target.trap_share:.2%} (u {target.u_trap_share:.2%}) of the white beside them"
    return sealed_outcome(
        "glare",
        request,
        frames,
        (width, height),
        Findings(
            *_parameters(fits),
            limits=against_limits(GLARE, request.limits, figures),
            fixed_figures=fixed_figures,
            remarks=(*by_words, f"{words}; {light}", *remarks),
            more_inputs=tuple(pair for path in files for pair in record_input(path)),
            artefacts=used_as("glare target", target.artefact),
        ),
        partial(draw_glare, fits),
    )


def _parameters(fits: Mapping[str, GlareFit]) -> tuple[list[Parameter], Floats]:
    parameters = [
        Parameter(
            name=f"{SHARE}.{part}.{channel}",
            value=float(value),
            u=float(u),
            degrees_of_freedom=fit.degrees_of_freedom,
            dominated_by="light from nearer than the traps' rims"
            if part == "near"
            else "differences between views",
        )
        for channel, fit in fits.items()
        for part, value, u in zip(PARTS, fit.shares, np.sqrt(np.diag(fit.covariance)), strict=True)
    ]
    return parameters, block_diagonal([fit.covariance for fit in fits.values()])


def _usable_frames(frames: LightFrames) -> dict[tuple[str, Light], list[LightFrame]]:
    """Return frames by view and light, of the longest exposure with almost no saturated pixel. Raises InputError
    if there are none."""
    if not frames.lit:
        raise InputError("glare: no frame with light; acquire `coupole plan new glare`")
    groups = frames.brightest(_MOST_SATURATED)
    bright = {key: group for key, group in groups.items() if group}
    if not bright:
        raise InputError(
            f"glare: all {len(groups)} views have saturated pixels, whose light is not known; expose less, and "
            "keep lamps and their mirror images out of the picture"
        )
    return dict(sorted(bright.items(), key=lambda item: item[0][0]))


def _even_brightness(signal: Floats, masks: Mapping[str, NDArray[np.bool_]]) -> NDArray[np.float32]:
    """Return [h, w] with all channels at the brightness of white, for finding traps."""
    even = np.empty(signal.shape, np.float32)
    for mask in masks.values():
        even[mask] = signal[mask] / max(float(np.quantile(signal[mask], 0.9)), 1e-9)
    return even
