"""Makes the record of the flat field from views of a luminous panel."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light import drawing as pictures
from coupole.calibration.light.flat_field import (
    G_NAMES,
    PANEL_NAMES,
    FlatField,
    FlatView,
    Spot,
    block_means,
    dust_spots,
    fit_flat_field,
    panel_places,
)
from coupole.calibration.light.frames import LightFrame, LightFrames, channel_mask, channels_of
from coupole.calibration.light.radiometric_record import Findings, sealed_outcome
from coupole.calibration.light.records import (
    Progress,
    block_diagonal,
    dark_signal,
    h5_of,
    limit_of,
    linearise,
    mean_of,
    record_input,
)
from coupole.calibration.record import Limit, Parameter
from coupole.calibration.report import Outcome
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats
from coupole.errors import InputError
from coupole.plan.shot_id import Light

_BLOCKS = 64
"""Number of blocks across the field."""
_ROWS = 64
"""Number of rows that are processed together if all pixels are used. This limits the memory."""
_MOST_SATURATED = 1e-3
_MOST_FLAT_U = 0.005
_MOST_DUST_DEPTH = 0.05
_MOST_PANEL, _MOST_OFF_ROUND = 0.003, 0.03


def flat_field_outcome(
    frames: LightFrames,
    request: Request,
    dark_record: Path | None,
    response_record: Path | None,
    panel_mm: float,
    progress: Progress,
    *,
    hand_eye: Path | None = None,
) -> Outcome:
    """Find fall-off and dust from views of a panel, shifted and turned. The panel is `panel_mm` in front of the
    camera's mean position, perpendicular to its mean axis. `hand_eye` is the record that posed the frames."""
    if not frames.lit:
        raise InputError("flat field: no frame with light; acquire `coupole plan new flat-field`")
    by_view = _brightest(frames)
    base_from_panel = _plane_before([group[0].base_from_camera for group in by_view.values()], panel_mm)
    dark = dark_signal(frames, dark_record)
    channels = channels_of(frames.pattern)
    straight = {channel: linearise(response_record, channel, frames) for channel in channels}
    size_px = frames.size_px
    views: dict[str, list[FlatView]] = {channel: [] for channel in channels}
    for number, ((view, light), group) in enumerate(by_view.items()):
        for channel, block_view in _flat_views(
            f"{view}/{light}", group, frames, dark, straight, base_from_panel
        ).items():
            views[channel].append(block_view)
        progress(number + 1, len(by_view))
    fits = {
        channel: fit_flat_field(views[channel], channel=channel, focal_px=frames.focal_px, size_px=size_px)
        for channel in channels
    }
    g = _map_of_pattern({channel: fit.map() for channel, fit in fits.items()}, frames.pattern)
    ratio, u_ratio = _ratio(list(by_view.values()), dark, straight, fits, frames, base_from_panel)
    spots = dust_spots(ratio)
    parameters, covariance = _flat_parameters(fits)
    inputs = (*record_input(dark_record), *record_input(response_record), *record_input(hand_eye))
    dust = [f"({s.column_px:.0f}, {s.row_px:.0f}) by {s.depth:.1%}" for s in spots[:5]]
    remarks = [f"{len(spots)} dust spots on the sensor, the deepest at {', '.join(dust)}"] if spots else []
    remarks += dict.fromkeys(sentence for fit in fits.values() for sentence in fit.causes.sentences())
    table = np.array([(s.column_px, s.row_px, s.pixels, s.depth) for s in spots]).reshape(-1, 4)
    return sealed_outcome(
        "flat-field",
        request,
        frames,
        size_px,
        Findings(
            parameters,
            covariance,
            limits=limits_of(fits, spots, size_px),
            files={f"{request.name}.h5": h5_of({"g": g, "pixel_response": ratio, "dust_x_y_pixels_depth": table})},
            fixed_figures={"focal_px": frames.focal_px, "u_pixel_response": u_ratio},
            remarks=remarks,
            more_inputs=inputs,
        ),
        partial(pictures.draw_flat_field, fits, ratio, spots),
    )


def limits_of(fits: Mapping[str, FlatField], spots: Sequence[Spot], size_px: tuple[int, int]) -> tuple[Limit, ...]:
    """Compare the fall-offs of all channels with their limits."""
    width, height = size_px
    corners = np.array([(0.0, 0.0), (width - 1.0, 0.0), (0.0, height - 1.0), (width - 1.0, height - 1.0)])
    worst = max(float(fit.u_at(corners).max()) for fit in fits.values())
    rejected_share = max(fit.rejected_share for fit in fits.values())
    deepest = max((spot.depth for spot in spots), default=0.0)
    return (
        limit_of("uncertainty in the field's corners", worst, _MOST_FLAT_U),
        limit_of("share of blocks left out", rejected_share, 0.05),
        limit_of("deepest dust", deepest, _MOST_DUST_DEPTH),
        limit_of("pattern of the panel", max(fit.causes.panel for fit in fits.values()), _MOST_PANEL),
        limit_of(
            "fall-off that is not round", max(fit.causes.off_round for fit in fits.values()), _MOST_OFF_ROUND
        ),
    )


def _flat_views(
    name: str,
    view_frames: Sequence[LightFrame],
    frames: LightFrames,
    dark: Callable[[LightFrame], NDArray[np.float32]],
    straight: Mapping[str, Callable[[Floats], Floats]],
    base_from_panel: Floats,
) -> dict[str, FlatView]:
    """Return one view's frames as means of blocks, by channel."""
    mean, black = mean_of(view_frames), dark(view_frames[0])
    height, width = mean.shape
    block_px = max(8, 2 * round(width / _BLOCKS / 2))
    is_saturated = _any_saturated(view_frames, frames.white_dn)
    views = {}
    for channel, linear in straight.items():
        mask = channel_mask((height, width), frames.pattern, channel)
        signal = linear(np.asarray(mean - black, np.float64))
        pixels, values = block_means(signal, mask, block_px, saturation_mask=is_saturated)
        pose = view_frames[0].base_from_camera
        places = panel_places(pixels, frames.focal_px, (width, height), pose, base_from_panel)
        views[channel] = FlatView(name, pixels, values, places)
    return views


def _brightest(frames: LightFrames) -> dict[tuple[str, Light], list[LightFrame]]:
    """Return frames by view and light, of the longest exposure with a share of saturated pixels below
    `_MOST_SATURATED`.

    Raises InputError if fewer than three views have such frames.
    """
    groups = frames.brightest(_MOST_SATURATED)
    views = {key: group for key, group in groups.items() if group}
    if len(views) < 3:
        raise InputError(
            f"flat field: expected three views or more that are not saturated, found {len(views)} of {len(groups)}"
            "; bracket the exposure downwards"
        )
    return views


def _plane_before(base_from_cameras: Sequence[Floats], panel_mm: float) -> Floats:
    """Return base_from_panel [4, 4]."""
    centre = np.mean([pose[:3, 3] for pose in base_from_cameras], axis=0)
    axis = np.mean([pose[:3, 2] for pose in base_from_cameras], axis=0)
    axis /= np.linalg.norm(axis)
    x = base_from_cameras[0][:3, 0] - axis * (base_from_cameras[0][:3, 0] @ axis)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([x, np.cross(axis, x), axis, centre + panel_mm * axis], axis=1)
    return pose


def _flat_parameters(fits: Mapping[str, FlatField]) -> tuple[list[Parameter], Floats]:
    parameters: list[Parameter] = []
    blocks: list[Floats] = []
    for channel, fit in fits.items():
        for names, values, covariance in (
            (G_NAMES, fit.parameters, fit.covariance),
            (PANEL_NAMES, fit.panel, fit.panel_covariance),
        ):
            u = np.sqrt(np.diag(covariance))
            parameters += [
                Parameter(
                    name=f"{name}.{channel}",
                    value=float(value),
                    u=float(sigma),
                    degrees_of_freedom=fit.degrees_of_freedom,
                    dominated_by="pixels' own responses",
                )
                for name, value, sigma in zip(names, values, u, strict=True)
            ]
            blocks.append(covariance)
    return parameters, block_diagonal(blocks)


def _ratio(
    views: Sequence[Sequence[LightFrame]],
    dark: Callable[[LightFrame], NDArray[np.float32]],
    straight: Mapping[str, Callable[[Floats], Floats]],
    fits: Mapping[str, FlatField],
    frames: LightFrames,
    base_from_panel: Floats,
) -> tuple[NDArray[np.float32], float]:
    """Return [H, W], the mean over views of signal over fitted signal, which shows the response of single pixels
    and dust. Also return its standard uncertainty from the differences between views."""
    size_px = next(iter(fits.values())).size_px
    width, height = size_px
    total, squares = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    masks = {channel: channel_mask((height, width), frames.pattern, channel) for channel in fits}
    for view_frames in views:
        signal = mean_of(view_frames) - dark(view_frames[0])
        for channel, fit in fits.items():
            ratio = np.zeros((height, width), np.float32)
            for first in range(0, height, _ROWS):
                rows = slice(first, min(first + _ROWS, height))
                at = np.argwhere(masks[channel][rows]) + np.array([first, 0])
                pixels = at[:, ::-1].astype(float)
                pose = view_frames[0].base_from_camera
                x, y = panel_places(pixels, fit.focal_px, size_px, pose, base_from_panel).T / 100.0
                shine = np.exp(np.column_stack([x, y, x * x, x * y, y * y]) @ fit.panel)
                values = straight[channel](signal[at[:, 0], at[:, 1]].astype(np.float64))
                ratio[at[:, 0], at[:, 1]] = values / (fit.at(pixels) * shine)
            channel_ratio = ratio[masks[channel]]
            channel_ratio /= np.float32(np.median(channel_ratio))
            total[masks[channel]] += channel_ratio
            squares[masks[channel]] += (channel_ratio - 1) ** 2
    mean = total / np.float32(len(views))
    variance = (squares / np.float32(len(views)) - (mean - 1) ** 2) / (len(views) - 1)
    return mean, float(np.sqrt(max(float(variance.mean(dtype=np.float64)), 0.0)))


def _any_saturated(frames: Sequence[LightFrame], white_dn: int) -> NDArray[np.bool_]:
    is_saturated = frames[0].read() >= white_dn
    for frame in frames[1:]:
        is_saturated |= frame.read() >= white_dn
    return is_saturated


def _map_of_pattern(maps: Mapping[str, NDArray[np.float32]], pattern: str) -> NDArray[np.float32]:
    """Return [H, W], with the pixels of each channel from the map of that channel."""
    shape = next(iter(maps.values())).shape
    pattern_map = np.zeros(shape, np.float32)
    for channel, values in maps.items():
        mask = channel_mask((shape[0], shape[1]), pattern, channel)
        pattern_map[mask] = values[mask]
    return pattern_map
