"""Disk space of a run whose frames are discarded when their samples are safe. The figure is the most that is
occupied at any time.

The sizes of samples and fits are upper bounds. They follow from the triangles that face a view's camera and from
the layout of the files (`tests/runs/test_discarded_frames.py` compares them with files).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.plan.exposures import AutoExposure
from coupole.plan.held_out import held_out_leds
from coupole.plan.rig import Rig
from coupole.plan.schedule import Schedule, ViewPose
from coupole.plan.shot_id import Led, ShotLabel
from coupole.preflight.framing import camera_at
from coupole.preflight.job import Job
from coupole.storage.frame_file import SPARE_SLOTS
from coupole.storage.run import Occupied

_BLOCK, _LANES = 4096, 8
"""Greatest numbers of triangles and LEDs of a chunk of samples."""
_TRIANGLE_BYTES = 200
"""Bytes of a triangle in a view's file in addition to its samples."""
_PICTURES = 12
"""Greatest number of pictures of a view for the check."""
_FIT_BYTES, _MATERIAL_BYTES = 1250, 360
"""Bytes of the fits: the first number is for a triangle of a view and each channel, the second for a triangle of
the mesh."""
_SMALL_BYTES = 4_000_000
"""Bytes of reports and of other data that belong to no triangle. The reports of a view need less."""
_LEAST_COSINE = -0.05
"""Least cosine between a triangle's normal and the direction to the camera. A triangle below this value cannot be
seen, even if the pose has a small error."""


@dataclass(frozen=True)
class ViewRoom:
    """Bytes of a view."""

    frame_bytes: int
    """Bytes of its file while it is taken."""
    kept_bytes: int
    """Bytes of its file after frames were discarded."""
    sample_bytes: int
    """Greatest size of its samples, with the pictures for the check."""


@dataclass(frozen=True)
class DiscardRoom:
    """Bytes of a run."""

    views: Mapping[str, ViewRoom]
    """Bytes of each view, by its name."""
    fit_bytes: int
    """Greatest size of fits and report, and of the copy of samples that exists while samples are replaced."""
    reserve_bytes: int
    """Bytes that must stay free."""

    def peak_bytes(self, space: Occupied, unfinished_views: Collection[str]) -> int:
        """Return the most bytes that the run needs at any time beyond those that its views occupy. Frames of the
        `unfinished_views` are still to be taken. The other views wait to be discarded, or are settled. The reserve
        is not counted."""
        other_views = [name for name in self.views if name in unfinished_views]
        waiting_views = [name for name in self.views if name not in {*other_views, *space.settled_views}]
        samples = sum(self.views[name].sample_bytes for name in waiting_views)
        all_samples = samples + sum(self.views[name].sample_bytes for name in other_views)
        kept_bytes = sum(
            self.views[name].kept_bytes - space.bytes_of_view.get(name, 0)
            for name in (*waiting_views, *other_views)
        )
        largest = max(
            (self.views[name].frame_bytes - self.views[name].kept_bytes for name in other_views), default=0
        )
        return max(samples, all_samples + kept_bytes + max(largest, self.fit_bytes), 0)

    @property
    def staying_bytes(self) -> int:
        """Most bytes that the whole run leaves on the disk: the kept part of its frames, its samples and fits."""
        return sum(view.kept_bytes + view.sample_bytes for view in self.views.values()) + self.fit_bytes

    def needed_bytes(self, view: str, waiting: Collection[str]) -> int:
        """Return the bytes that must be free when a view begins, while samples of the `waiting` views are still to
        be written."""
        samples = sum(self.views[name].sample_bytes for name in waiting if name in self.views)
        view_room = self.views[view]
        return view_room.frame_bytes + view_room.sample_bytes + samples + self.reserve_bytes


def discard_room(job: Job) -> DiscardRoom:
    """Return the room that a job's views need."""
    rig, schedule = job.cell.rig, job.schedule
    held_out = set(held_out_leds(_leds(schedule)))
    channels = 1 if rig.sensor.bayer_pattern == "MONO" else 3
    has_glare = any(item.record.kind == "glare" for item in job.calibrations or ())
    views, seen_counts = {}, []
    for view, bursts in zip(schedule.views, schedule.bursts, strict=True):
        labels = [label for burst in bursts for label in burst.labels if label is not None]
        seen_counts.append(_most_seen(job.shape.corners_mm, rig, view))
        views[view.name] = _view_room(labels, held_out, rig, seen_counts[-1], channels, has_glare=has_glare)
    fits = sum(seen_counts) * channels * _FIT_BYTES + len(job.shape.corners_mm) * _MATERIAL_BYTES
    copy = max((view.sample_bytes for view in views.values()), default=0)
    return DiscardRoom(views, fits + copy + _SMALL_BYTES, rig.storage.reserve_bytes)


def refusals_of_discarding(job: Job) -> list[str]:
    """Reasons why the frames of a plan cannot be discarded, with the place in the plan."""
    if job.plan.discard is None:
        return []
    messages = []
    if job.plan.chooses_lights:
        messages.append(
            "expected LEDs that are known beforehand: with `lights: {kind: adaptive}` the LEDs that are kept for "
            "the check are known only after the last view, so no frame could be discarded"
        )
    elif isinstance(job.plan.exposure, AutoExposure) and any(view.lights for view in job.plan.view_entries):
        messages.append(
            "expected the same lights in all views with `exposure: {kind: auto}`: otherwise it is not known "
            "beforehand which LEDs are kept for the check"
        )
    elif not held_out_leds(_leds(job.schedule)):
        messages.append("expected five LEDs or more, so that the frames of one are kept for the check")
    return [str(job.document.problem(("discard",), message)) for message in messages]


def _leds(schedule: Schedule) -> set[int]:
    labels = (label for bursts in schedule.bursts for burst in bursts for label in burst.labels)
    return {label.light.id for label in labels if label is not None and isinstance(label.light, Led)}


def _view_room(
    labels: Sequence[ShotLabel],
    held_out: Collection[int],
    rig: Rig,
    seen_count: int,
    channels: int,
    *,
    has_glare: bool,
) -> ViewRoom:
    leds = {label.light.id for label in labels if isinstance(label.light, Led)}
    kept_count = sum(not isinstance(label.light, Led) or label.light.id in held_out for label in labels)
    rows, columns = -(-seen_count // _BLOCK) * _BLOCK, -(-len(leds) // _LANES) * _LANES
    samples = rows * columns * (channels * (8 if has_glare else 6) + 1) + seen_count * _TRIANGLE_BYTES
    pixels = rig.sensor.width_px * rig.sensor.height_px
    pictures = min(_PICTURES, len(leds & set(held_out))) * (pixels // 4) * channels * 2
    small = _SMALL_BYTES // 4
    return ViewRoom(
        (len(labels) + SPARE_SLOTS) * rig.frame_bytes + small,
        kept_count * rig.frame_bytes + small,
        samples + pictures + pixels * 4 + small,
    )


def _most_seen(corners_mm: NDArray[np.float64], rig: Rig, view: ViewPose) -> int:
    """Return the largest number of triangles [n, 3, 3] (support frame) that a view can see."""
    pixels = rig.sensor.width_px * rig.sensor.height_px
    pose = view.support_from_camera
    if pose is None:
        pose = camera_at(np.array(view.joints_deg), rig)
    normals = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    towards = pose[:3, 3] - corners_mm.mean(axis=1)
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(towards, axis=1)
    facing = np.einsum("nk,nk->n", normals, towards) > _LEAST_COSINE * lengths
    return min(int(np.count_nonzero(facing)), pixels)
