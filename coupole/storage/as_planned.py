"""Compares frames with the run's own plan: light, exposure and pose, by the plan and the rig in the run's
`inputs/`.

A frame's LED comes from the box's log, its exposure from the command, and its pose from the measured joints of the
arm. The object's mesh is not needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from coupole.devices import NO_LED
from coupole.errors import InputError
from coupole.geometry import inverse, rotation_angle_deg
from coupole.intake.input_files import InputFiles
from coupole.kinematics import Arm, forward
from coupole.plan import yamlfile
from coupole.plan.arm_description import arm_named
from coupole.plan.choices import has_enough
from coupole.plan.led_table import read_led_table
from coupole.plan.plan import Plan
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import device_times
from coupole.plan.schedule import Schedule, build_schedule
from coupole.plan.shot_id import ShotId, ShotLabel
from coupole.plan.view_choices import problem_of_views
from coupole.storage.run import Run
from coupole.storage.step_fields import STORED_NO_LED

_SETTLED_DEG = 0.1
"""Allowed deviation of each axis from its goal, deg, in addition to the motion that is allowed in a burst (the
rig's `still_deg`)."""
_REACH_MM = 2000.0
"""Reach of an arm. An error of an axis moves the camera by at most the error's angle times this radius."""


@dataclass(frozen=True, eq=False)
class AsPlanned:
    """The run's plan as a schedule."""

    rig: Rig
    schedule: Schedule
    arm: Arm | None
    """None if nothing describes the arm; poses are then not compared."""

    def problems_of_the_list(self, run: Run) -> Iterator[str]:
        """Find shots under a light that are in `run.json` but not in the plan, and the reverse."""
        chosen_views = set(run.views)
        planned_shots = {
            ShotId(view.name, label)
            for view, labels in zip(self.schedule.views, self.schedule.labels, strict=True)
            if run.most_views is None or view.name in chosen_views
            for label in labels
            if label.is_shot and getattr(label.light, "id", None) not in run.hidden_leds.get(view.name, ())
        }
        listed_shots = {shot for shot in run.expected_shots() if shot.is_shot}
        have_listed = "journal's choices" if self.schedule.is_open else "run.json"
        left_out = set() if self.schedule.is_open else planned_shots - listed_shots
        for shots, have, lack in (
            (listed_shots - planned_shots, have_listed, "plan"),
            (left_out, "plan", have_listed),
        ):
            if shots:
                first = min(map(str, shots))
                yield f"{len(shots)} shots of the run's {have} are not in its {lack}, the first {first}"

    def problems_of_choices(self, run: Run) -> Iterator[str]:
        """Find choices of the journal that the plan does not allow, or whose exposure time differs from the
        plan's."""
        if problem := problem_of_views(self.schedule, run.chosen_views()):
            yield f"the journal has a choice that the run's plan does not allow: {problem}"
        choices = run.choices()
        for number, view in enumerate(self.schedule.views if self.schedule.is_open else ()):
            open_view, view_choices = self.schedule.open_view(number), choices.get(view.name, ())
            if has_enough(view_choices) and not any(choice.bursts for choice in view_choices):
                yield f"the journal says that {view.name} is complete, although no frame was chosen for it"
            for chosen_burst in (burst for choice in view_choices for burst in choice.bursts):
                try:
                    open_view.burst_of(chosen_burst)
                except KeyError as error:
                    yield f"the journal has a choice that the run's plan does not allow: {error.args[0]}"

    def problem(self, shot: ShotId, record: Any, pose: Any) -> str:
        """Say how a frame's record (FRAME_DTYPE) and pose (POSE_DTYPE) differ from the plan; empty if they do
        not."""
        planned_light = self._planned_exposures(shot.view).get(shot.label)
        if planned_light is None:
            return f"{shot}: the run's plan has no such shot" if shot.is_shot else ""
        led, exposure_us = planned_light
        if int(record["exposure_us"]) != exposure_us:
            recorded_us = int(record["exposure_us"])
            return f"{shot}: exposed for {recorded_us} us, where the run's plan has {exposure_us} us"
        if int(record["led"]) != led:
            return f"{shot}: lit by {_words(int(record['led']))}, where the run's plan has {_words(led)}"
        return f"{shot}: {off}" if (off := self._off(shot.view, pose["joints_deg"].tobytes())) else ""

    @lru_cache(maxsize=1)  # noqa: B019  an object of one `verify`
    def _planned_exposures(self, view: str) -> dict[ShotLabel, tuple[int, int]]:
        """Return LED and exposure, us, of each frame of a view."""
        light_of_label: dict[ShotLabel, tuple[int, int]] = {}
        for pose, bursts in zip(self.schedule.views, self.schedule.planned_bursts(), strict=True):
            for burst in bursts if pose.name == view else ():
                for label, led in zip(burst.labels, burst.table["led"], strict=True):
                    if label is not None:
                        led_number = STORED_NO_LED if led == NO_LED else int(led)
                        light_of_label[label] = (led_number, burst.timing.exposure_us)
        return light_of_label

    @lru_cache(maxsize=16)  # noqa: B019
    def _off(self, view: str, joints: bytes) -> str:
        """Say how far the arm was from a view; empty if it was there."""
        joints_deg = np.frombuffer(joints)
        planned_pose = next(pose for pose in self.schedule.views if pose.name == view)
        allowed_deg = _SETTLED_DEG + self.rig.motion.still_deg
        if planned_pose.joints_deg is not None:
            off_deg = float(np.abs(joints_deg - planned_pose.joints_deg).max())
            return f"an axis was {off_deg:.2f} deg from the plan's posture" if off_deg > allowed_deg else ""
        if self.arm is None or planned_pose.support_from_camera is None:
            return ""
        support_from_base = inverse(self.rig.support.base_from_support.matrix())
        flange_from_camera = self.rig.flange_from_camera.matrix()
        support_from_camera = support_from_base @ forward(self.arm, joints_deg) @ flange_from_camera
        off_mm = float(np.linalg.norm(support_from_camera[:3, 3] - planned_pose.support_from_camera[:3, 3]))
        off_deg = rotation_angle_deg(support_from_camera, planned_pose.support_from_camera)
        if off_mm <= math.radians(allowed_deg) * _REACH_MM and off_deg <= 3 * allowed_deg:
            return ""
        return f"the camera was {off_mm:.1f} mm and {off_deg:.2f} deg from its pose in the run's plan"


def as_planned(run: Run) -> AsPlanned:
    """Return the plan that the run keeps. Raises InputError if the run keeps no plan, or if it is not understood
    any more."""
    if "stored" not in run.about["plan"] or "stored" not in run.about["rig"]:
        raise InputError("the run keeps no copy of its plan and rig")
    files = InputFiles()
    plan = yamlfile.read_document(run.plan_path, files).validate(Plan)
    document = yamlfile.read_document(run.rig_path, files)
    rig = document.validate(Rig)
    leds = read_led_table(document.resolve(rig.dome.leds), files)
    description, _ = arm_named(document, rig.arm, rig.robot.driver, rig.robot.settings, files)
    schedule = build_schedule(plan, leds, rig.support.base_from_support.matrix(), device_times(rig))
    return AsPlanned(rig, schedule, description.arm if description else None)


def _words(led: int) -> str:
    return "no LED" if led == STORED_NO_LED else f"LED {led}"
