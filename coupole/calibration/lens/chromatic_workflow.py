"""Makes the record of lateral chromatic aberration and its picture, from a board's images in three colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coupole.calibration import optics
from coupole.calibration.acceptance import against_limits
from coupole.calibration.grey_image import CHANNELS, Channel
from coupole.calibration.lens.acceptance import CHROMATIC
from coupole.calibration.lens.board import Board, Sighting, in_channel
from coupole.calibration.lens.camera import calibrate_camera, without_gross_errors
from coupole.calibration.lens.chromatic import SHARED, ChannelLenses, calibrate_channels
from coupole.calibration.lens.images import Found
from coupole.calibration.lens.workflow import content_of, image_figures, image_lines, unit_name
from coupole.calibration.record import Noise, Parameter, Record, rows_of, seal_record
from coupole.calibration.report import BLUE, DARK, RED
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats
from coupole.calibration.sources import Sources

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STEPS = (13, 10)


@dataclass(frozen=True)
class ChromaticFound:
    """The result, and the data that the report draws."""

    record: Record
    lenses: ChannelLenses
    size_px: tuple[int, int]
    field_px: Floats
    """[k, 2] places in the field at which shifts are given."""
    shifts: dict[str, tuple[Floats, Floats]]
    """Shifts by channel against green, px [k, 2], and their covariances, px^2 [k, 2, 2]."""


def chromatic_from(
    board_images: Found, sources: Sources, board: Board, model: str, request: Request
) -> ChromaticFound:
    """Estimate a lens for each colour from the same images. Raises InputError for images without colours."""
    fit = calibrate_camera(board_images.sightings, board_images.size_px, model)
    good_sightings = without_gross_errors(fit)
    sightings: dict[str, list[Sighting]] = {
        channel: _in_channel(channel, good_sightings, board_images, sources, board) for channel in CHANNELS
    }
    lenses = calibrate_channels(sightings, board_images.size_px, model)
    field_px = _field(board_images.size_px)
    shifts: dict[str, tuple[Floats, Floats]] = {
        channel: lenses.shift(channel, "green", field_px) for channel in CHANNELS[1:]
    }
    u_px = max(float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).max())) for _, covariance in shifts.values())
    residuals = tuple(r[keep] for r, keep in zip(fit.residuals_px, fit.accepted_masks, strict=True))
    record = seal_record(
        kind="chromatic",
        transforms={},
        parameters=_parameters(lenses),
        covariance=rows_of(lenses.covariance),
        noise=tuple(
            Noise(
                name=f"corners in {channel}",
                unit="px",
                stated=0.0,
                found=sigma,
                redundancy=_redundancy(good_sightings, fit.free),
            )
            for channel, sigma in lenses.sigma_px.items()
        ),
        limits=against_limits(CHROMATIC, request.limits, {**image_figures(fit, board_images), "shift_px": u_px}),
        remarks=(*(_remark(channel, *shift) for channel, shift in shifts.items()), *board_images.left_out),
        fixed={
            f"{channel}.{unit_name(name)}": getattr(lenses.intrinsics[channel], name)
            for channel in CHANNELS
            for name in optics.NAMES
            if name not in fit.free
        },
        images=image_lines(good_sightings, residuals, fit.sightings),
        **content_of(board_images, sources, request),
    )
    return ChromaticFound(record, lenses, board_images.size_px, field_px, shifts)


def _in_channel(
    channel: Channel, accepted_sightings: tuple[Sighting, ...], board_images: Found, sources: Sources, board: Board
) -> list[Sighting]:
    """Return the sightings in a channel, from the sightings in green."""
    if channel == "green":
        return list(accepted_sightings)
    return [
        in_channel(board, sources.images[number].read_picture(), channel, sighting)
        for number, sighting in zip(board_images.image_numbers, accepted_sightings, strict=True)
    ]


def _field(size_px: tuple[int, int]) -> Floats:
    """Return [k, 2], a grid over the field with its rim."""
    across, down = (np.linspace(0.0, size - 1.0, count) for size, count in zip(size_px, _STEPS, strict=True))
    return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)


def _parameters(lenses: ChannelLenses) -> tuple[Parameter, ...]:
    u = np.sqrt(np.diag(lenses.covariance))
    parameters = []
    for at, full in enumerate(lenses.names):
        channel, _, name = full.partition(".")
        lens = lenses.intrinsics["green" if channel == SHARED else channel]
        parameters.append(
            Parameter(
                name=f"{channel}.{unit_name(name)}",
                value=float(getattr(lens, name)),
                u=float(u[at]),
                degrees_of_freedom=float(lenses.degrees[at]),
                dominated_by="corners",
            )
        )
    return tuple(parameters)


def _redundancy(accepted_sightings: tuple[Sighting, ...], free: tuple[str, ...]) -> float:
    """Return the redundancy of one channel, which shares the poses of the images with the others."""
    return float(
        sum(2 * len(sighting.ids) for sighting in accepted_sightings)
        - len(free)
        - 6 * len(accepted_sightings) / len(CHANNELS)
    )


def _remark(channel: str, shift: Floats, shift_covariance: Floats) -> str:
    length = np.linalg.norm(shift, axis=1)
    worst = int(np.argmax(length))
    u = float(np.sqrt(np.trace(shift_covariance[worst])))
    return (
        f"{channel} is seen up to {length[worst]:.3f} px (u {u:.3f} px) from green, root mean square over the "
        f"field {np.sqrt(np.mean(length**2)):.3f} px"
    )


# -- the picture ----------------------------------------------------------------------------------------------


def draw_chromatic(result: ChromaticFound, figure: Figure) -> None:
    """Fill the figure: shifts over the field above, and along the radius below. Red is on the left, blue on the
    right."""
    axes = figure.subplots(2, 2)
    longest = max(float(np.linalg.norm(shift, axis=1).max()) for shift, _ in result.shifts.values())
    enlargement = float(f"{0.06 * result.size_px[0] / max(longest, 1e-6):.1g}")
    for column, (channel, colour) in enumerate((("red", RED), ("blue", BLUE))):
        _draw_field(axes[0, column], result, channel, colour, enlargement)
        _draw_radius(axes[1, column], result, channel, colour)


def _draw_field(ax: Axes, result: ChromaticFound, channel: str, colour: str, enlargement: float) -> None:
    shift, _ = result.shifts[channel]
    width, height = result.size_px
    ax.quiver(
        *result.field_px.T,
        *shift.T * enlargement,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.003,
        color=colour,
    )
    ax.set(
        xlim=(-0.05 * width, 1.05 * width), ylim=(1.05 * height, -0.05 * height), aspect="equal", xlabel="x (px)",
        ylabel="y (px)", title=f"{channel} against green, {enlargement:g} times enlarged",
    )  # fmt: skip


def _draw_radius(ax: Axes, result: ChromaticFound, channel: str, colour: str) -> None:
    """Draw the shift away from the principal point, with its 95 % interval."""
    shift, covariance = result.shifts[channel]
    lens = result.lenses.intrinsics["green"]
    away = result.field_px - (lens.cx, lens.cy)
    radius = np.linalg.norm(away, axis=1)
    outward = away / np.maximum(radius, 1e-9)[:, None]
    along = np.einsum("ki,ki->k", shift, outward)
    u = np.sqrt(np.einsum("ki,kij,kj->k", outward, covariance, outward))
    ax.errorbar(radius, along, 1.96 * u, fmt=".", color=colour, lw=0.8)
    ax.axhline(0.0, color=DARK, lw=0.8)
    ax.set(title=f"{channel}: outward, 95 %", xlabel="from the principal point (px)", ylabel="px")
