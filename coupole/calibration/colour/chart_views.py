"""The chart in frames of runs: linear signals, and its place from its described pose or from its corners in the
picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from coupole.calibration import optics
from coupole.calibration.colour.chart import Chart
from coupole.calibration.colour.chart_signals import MONO, ChartPicture
from coupole.calibration.light.frames import CHANNELS, LightFrame, LightFrames, channel_mask
from coupole.calibration.light.glare_correction import read_glare
from coupole.calibration.light.irradiance import irradiance_per_flux
from coupole.calibration.light.lit_cell import LitCell
from coupole.calibration.light.records import dark_signal, linearise, map_beside
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

_LEAST_COSINE = 0.3
"""Least cosine of incidence on the chart. Light at less than 17 degrees to the chart's plane shows the surface of
the patches, not their colour."""
_GLOSS_DEG = 25.0
"""Light that comes from within this angle of the direction that the chart mirrors into the camera is not used
(45/0 geometry also avoids it)."""


@dataclass(frozen=True, kw_only=True)
class ChartSetting(LitCell):
    """Descriptions and calibrations for reading the chart's frames."""

    chart: Chart
    corners_px: Floats | None = None
    """[4, 2] middles of the corner patches in the picture, from the top left of the chart around it."""


class ChartReader:
    """Pictures of the chart from the lit frames of runs."""

    def __init__(self, frames: LightFrames, setting: ChartSetting) -> None:
        if frames.pattern == MONO:
            raise InputError("colour: the camera has one channel; it has no colours")
        if not frames.lit:
            raise InputError("colour: no frame with light; acquire configs/plans/colour-chart.yaml")
        self._frames, self._setting = frames, setting
        height, width = frames.lit[0].read().shape
        self._dark = dark_signal(frames, setting.dark)
        self._straight = {channel: linearise(setting.response, channel, frames) for channel in CHANNELS}
        self._masks = {channel: channel_mask((height, width), frames.pattern, channel) for channel in CHANNELS}
        self._flat = None if setting.flat is None else map_beside(setting.flat, "flat-field", "g", frames)
        self._glare = None if setting.glare is None else read_glare(setting.glare, frames)
        self._base_from_chart = self._find_chart()

    def pictures(self) -> Iterator[tuple[LightFrame, ChartPicture]]:
        """Yield each frame with suitable light. A frame is read when it is requested."""
        for frame in self.suitable_frames():
            yield frame, self.picture(frame, self._light(frame))

    def suitable_frames(self) -> list[LightFrame]:
        """Return the frames under light that does not graze the chart, and that the chart does not reflect into
        the camera. Raises InputError if there are none."""
        frames = [frame for frame in self._frames.lit if self._suits(frame)]
        if not frames:
            raise InputError(
                "colour: no light can be used: each one grazes the chart, or is reflected into the camera; "
                "expected LEDs at about 45 degrees to the chart, seen from above"
            )
        return frames

    def picture(self, frame: LightFrame, light: Floats) -> ChartPicture:
        """Return a frame as linear signals, DN/s over the flat field."""
        raw = frame.read()
        signal = (raw - self._dark(frame)).astype(np.float64)
        for channel, mask in self._masks.items():
            signal[mask] = self._straight[channel](signal[mask])
        if self._glare is not None:
            signal = self._glare.without_veil(signal, self._masks)
        if self._flat is not None:
            signal = signal / self._flat
        signal /= frame.exposure_us * 1e-6
        patches, edges = (
            self._projected_polygons(polygons, frame)
            for polygons in (self._setting.chart.patch_polygons_mm(), self._setting.chart.edge_polygons_mm())
        )
        full = raw >= self._frames.white_dn
        return ChartPicture(str(frame.shot), signal, full, self._frames.pattern, patches, edges, light)

    def _find_chart(self) -> Floats:
        """Return base_from_chart [4, 4], from the description or from the corners in the first view."""
        setting = self._setting
        if setting.corners_px is None:
            if setting.chart.support_from_chart is None:
                raise InputError(
                    "colour: where is the chart? Give `support_from_chart` in its description, or --corners with "
                    "the middles of its corner patches in the picture"
                )
            return np.asarray(setting.base_from_support @ setting.chart.support_from_chart.matrix())
        import cv2

        corners = np.column_stack([setting.chart.corners_mm, np.zeros(4)])
        is_solved, turn, shift = cv2.solvePnP(
            corners, setting.corners_px, setting.lens.matrix(), setting.lens.distortion(), flags=cv2.SOLVEPNP_IPPE
        )
        camera_from_chart = np.eye(4)
        camera_from_chart[:3, :3], camera_from_chart[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        if not is_solved or camera_from_chart[2, 2] > 0.0:
            raise InputError(
                "--corners: expected the middles of the top left, top right, bottom right and bottom left patch, "
                "clockwise on the chart; these points show the chart's back"
            )
        return np.asarray(self._frames.lit[0].base_from_camera @ camera_from_chart)

    def _projected_polygons(self, polygons_mm: Floats, frame: LightFrame) -> Floats:
        """Return [n, 4, 2] px for polygons [n, 4, 2] of the chart's face. Raises InputError if the face is behind
        the camera."""
        flat = np.column_stack([polygons_mm.reshape(-1, 2), np.zeros(4 * len(polygons_mm))])
        camera_from_chart = np.linalg.inv(frame.base_from_camera) @ self._base_from_chart
        points = flat @ camera_from_chart[:3, :3].T + camera_from_chart[:3, 3]
        if len(points) and points[:, 2].min() <= 0.0:
            raise InputError(f"{frame.shot}: the chart is behind the camera; correct its place in its description")
        return optics.project(points, self._setting.lens.vector()).pixels.reshape(-1, 4, 2)

    def _points(self) -> tuple[Floats, Floats]:
        """Return the middles of the patches [patches, 3] and the chart's normal [3], in the base frame."""
        centres = self._setting.chart.centres_mm
        flat = np.column_stack([centres, np.zeros(len(centres))])
        return flat @ self._base_from_chart[:3, :3].T + self._base_from_chart[:3, 3], self._base_from_chart[:3, 2]

    def _suits(self, frame: LightFrame) -> bool:
        if frame.led is None:
            return True
        points, normal = self._points()
        centre, _ = self._setting.positions.of(np.array([frame.led]))
        towards = centre - points
        towards /= np.linalg.norm(towards, axis=1)[:, None]
        away = frame.base_from_camera[:3, 3] - points
        away /= np.linalg.norm(away, axis=1)[:, None]
        reflection = 2.0 * (away @ normal)[:, None] * normal - away
        off_deg = np.degrees(np.arccos(np.clip((towards * reflection).sum(axis=1), -1.0, 1.0)))
        return bool((towards @ normal).min() > _LEAST_COSINE and off_deg.min() > _GLOSS_DEG)

    def _light(self, frame: LightFrame) -> Floats:
        """Return [patches], the irradiance of the frame's LED divided by its flux; 1 under a panel."""
        points, normal = self._points()
        if frame.led is None:
            return np.ones(len(points))
        centre, facing = self._setting.positions.of(np.array([frame.led]))
        return irradiance_per_flux(points, normal, centre, facing, emission=self._setting.emission)


def white_of(frames: LightFrames, setting: ChartSetting) -> dict[tuple[str, str], ChartPicture]:
    """Return pictures of a white sheet in the chart's place, by view and light. They replace the known
    irradiance."""
    reader = ChartReader(frames, setting)
    ones = np.ones(len(setting.chart.centres_mm))
    return {key_of(frame): reader.picture(frame, ones) for frame in reader.suitable_frames()}


def key_of(frame: LightFrame) -> tuple[str, str]:
    """Return view and light. Frames of the chart and of the white sheet with the same key belong together."""
    return frame.view, str(frame.shot.light)


def mean_picture(pictures: Sequence[ChartPicture]) -> ChartPicture:
    """Return the mean of pictures of one view. A pixel that is saturated in one picture is saturated in the
    mean."""
    first = pictures[0]
    signal = np.mean([picture.signal for picture in pictures], axis=0)
    full = np.any([picture.full for picture in pictures], axis=0)
    light = np.mean([picture.light for picture in pictures], axis=0)
    return ChartPicture(first.name, signal, full, first.pattern, first.patches_px, first.edges_px, light)
