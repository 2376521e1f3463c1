"""Description of an arm: chain of joints, limits and speeds of the joints, bodies of the links.

The files included with Coupole are in `configs/robots`; `shipped_arm` finds them. A rig names its arm's file under
`arm:`; otherwise it is the default arm of the robot's driver.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, cached_property
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from coupole.errors import InputError, Problem
from coupole.intake.input_files import InputFiles
from coupole.joint_chain import Axis, JointChain
from coupole.kinematics import Arm, structure_of
from coupole.plan import yamlfile
from coupole.plan.base_model import Degrees, FilePath, Length, Model, Pose, Vector
from coupole.plan.registry import ARMS_OF_DRIVERS, UR
from coupole.plan.shipped_files import shipped_folder, shipped_names
from coupole.plan.validation_messages import KeyPath
from coupole.plan.yamlfile import Document

TOOL = "tool"
"""Name for everything mounted on the flange."""
UR_MODEL = "ur10e"
"""The default arm of a UR's driver."""

_MOST_POSTURES = 10_000

BodyName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]{0,63}$")]
Positive = Annotated[float, Field(ge=0.001, le=10_000_000)]
Range = tuple[Annotated[float, Field(ge=-720, le=720)], Annotated[float, Field(ge=-720, le=720)]]


class JointDescription(Model):
    """One joint, in the frame of the link before it. With all angles 0, this frame is parallel to the base
    frame."""

    origin_mm: Vector
    """Origin of the joint, in the frame of the link before it."""
    axis: Axis
    """Axis of rotation, right-handed."""
    limits_deg: Range
    """Lowest and highest angle, from the data sheet."""
    posture_limits_deg: Range | None = None
    """Limits for planned postures. These limits are narrower than the joint's own limits if links would come near
    each other, or if cables would twist.
    """
    speed_deg_s: Positive
    """Greatest speed, from the data sheet."""
    acceleration_deg_s2: Positive
    """Greatest acceleration of the joint."""
    jerk_deg_s3: Positive = 3000.0
    """Greatest jerk."""


class CapsuleDescription(Model):
    """All points within `radius_mm` of a segment, in the frame of one link."""

    from_mm: Vector
    """One end of the segment."""
    to_mm: Vector
    """Its other end."""
    radius_mm: Length
    """Radius about the segment."""


class LinkDescription(Model):
    """The body of a link: capsules that enclose it."""

    name: BodyName
    """Name of the body in messages and pictures."""
    link: Annotated[int, Field(ge=0, le=6)]
    """Number of the link: 0 is the base, which is fixed; link k turns with joint k."""
    capsules: Annotated[tuple[CapsuleDescription, ...], Field(min_length=1, max_length=100)]
    """Together they enclose the body."""


class KeptApart(Model):
    """Two bodies of the arm that could touch. Pairs that are not listed touch by design, or cannot touch."""

    body: BodyName
    """One of the two bodies."""
    other: BodyName
    """The other body, nearer to the base than `body`."""
    near_by_design_deg: Annotated[
        tuple[Annotated[tuple[Degrees, ...], Field(min_length=1, max_length=360)], ...] | None,
        Field(min_length=6, max_length=6),
    ] = None
    """Angles of each joint. A part of `body` that is near `other` in all combinations of these angles is always
    near it, because of the joint between them, or because their capsules are too large. This part of `body` is
    not checked.
    """

    @model_validator(mode="after")
    def _few_combinations(self) -> KeptApart:
        combinations = prod(map(len, self.near_by_design_deg or ()))
        if combinations > _MOST_POSTURES:
            raise ValueError(f"at most {_MOST_POSTURES} combinations of angles, found {combinations}")
        return self


class ArmDescription(Model):
    """One arm. Link frames have their origins in the joints, and are parallel to the base frame when all angles
    are 0."""

    schema_version: Literal[1]
    """Version of the format of arms."""
    name: Annotated[str, Field(min_length=1, max_length=64)]
    """Model of the arm."""
    joints: Annotated[tuple[JointDescription, ...], Field(min_length=6, max_length=6)]
    """Joints, beginning at the base."""
    link_6_from_flange: Pose
    """Pose of the flange's frame in the frame of the last link."""
    links: Annotated[tuple[LinkDescription, ...], Field(min_length=1, max_length=100)]
    """Bodies of the links."""
    kept_apart: Annotated[tuple[KeptApart, ...], Field(max_length=1000)] = ()
    """Pairs of bodies that are checked against each other."""
    link_meshes: FilePath | None = None
    """Folder of meshes that replace the links' capsules; relative to the file."""

    @cached_property
    def arm(self) -> Arm:
        """The arm's kinematics, with limits, speeds and accelerations from the data sheet."""
        flange = self.link_6_from_flange.matrix().round(15) + 0.0
        chain = JointChain(
            tuple(joint.origin_mm for joint in self.joints),
            tuple(joint.axis for joint in self.joints),
            tuple(tuple(row) for row in flange.tolist()),
        )
        return Arm(
            self.name,
            chain,
            tuple(joint.limits_deg for joint in self.joints),
            tuple(joint.speed_deg_s for joint in self.joints),
            tuple(joint.acceleration_deg_s2 for joint in self.joints),
            tuple(joint.jerk_deg_s3 for joint in self.joints),
        )

    @property
    def posture_limits_deg(self) -> tuple[tuple[float, float], ...]:
        """Limits for plans: each joint's posture limits, or otherwise its limits."""
        return tuple(joint.posture_limits_deg or joint.limits_deg for joint in self.joints)


def read_arm(path: Path, files: InputFiles | None = None) -> ArmDescription:
    """Read an arm's file, from `files` if they are given. Raises InputError with all problems, each at its line
    and column."""
    document = yamlfile.read_document(path, files)
    description, problems = document.problems(ArmDescription)
    if description is not None:
        problems = description_problems(document, description)
    if description is None or problems:
        raise InputError(problems)
    if description.link_meshes is None:
        return description
    return description.model_copy(update={"link_meshes": document.resolve(description.link_meshes)})


def description_problems(document: Document, description: ArmDescription, at: KeyPath = ()) -> list[Problem]:
    """Return the mistakes of a description that involve several keys. `at` is its key path in the document."""
    problems = []
    for k, joint in enumerate(description.joints):
        (low, high), posture_limits_deg = joint.limits_deg, joint.posture_limits_deg or joint.limits_deg
        if not low < high:
            message = f"expected the lower limit first, found {low:g} and {high:g} deg"
            problems.append(document.problem((*at, "joints", k, "limits_deg"), message))
        elif not low <= posture_limits_deg[0] < posture_limits_deg[1] <= high:
            message = f"expected a part of the joint's limits, {low:g} to {high:g} deg"
            problems.append(document.problem((*at, "joints", k, "posture_limits_deg"), message))
    if structure_of(description.arm) is None:
        message = (
            "no closed solution for this chain: expected axes 2 and 3 parallel and axes 4, 5 and 6 that meet in a "
            "point, or axes 2, 3 and 4 parallel with axis 1 meeting 2, 4 meeting 5 and 5 meeting 6 at right angles"
        )
        problems.append(document.problem((*at, "joints"), message))
    return problems + _body_problems(document, description, at)


def _body_problems(document: Document, description: ArmDescription, at: KeyPath) -> list[Problem]:
    problems, links = [], {TOOL: 7}
    for k, link in enumerate(description.links):
        if link.name in links:
            message = f"expected a different name for each link; `{link.name}` is taken"
            problems.append(document.problem((*at, "links", k, "name"), message))
        links[link.name] = link.link
    for number in sorted(set(range(1, 7)) - set(links.values())):
        message = f"expected a body for each link, there is none of link {number}"
        problems.append(document.problem((*at, "links"), message))
    for k, pair in enumerate(description.kept_apart):
        unknown = [(key, name) for key, name in (("body", pair.body), ("other", pair.other)) if name not in links]
        for key, name in unknown:
            message = f"expected a body of `links` or `{TOOL}`, there is no `{name}`"
            problems.append(document.problem((*at, "kept_apart", k, key), message))
        if not unknown and links[pair.other] >= links[pair.body]:
            message = f"expected a body nearer to the base than `{pair.body}`"
            problems.append(document.problem((*at, "kept_apart", k, "other"), message))
    return problems


@cache
def shipped_arm(name: str) -> ArmDescription:
    """Return the included arm of this name. Raises InputError if there is none."""
    names = shipped_names("robots")
    if name in names:
        return read_arm(shipped_folder() / "robots" / f"{name}.yaml")
    why = f"expected one of {', '.join(names)}; another arm is named by its file, under the rig's `arm:`"
    raise InputError(f"no description of the arm `{name}` comes with Coupole: {why}")


def arm_named(
    document: Document,
    arm_reference: Path | ArmDescription | None,
    driver: str,
    settings: Mapping[str, Any],
    files: InputFiles,
) -> tuple[ArmDescription | None, list[Problem]]:
    """Return the arm under `arm:` in a rig's document, or otherwise the default arm of its driver, and the
    problems found in it."""
    if isinstance(arm_reference, ArmDescription):
        if arm_reference.link_meshes is not None:
            arm_reference = arm_reference.model_copy(
                update={"link_meshes": document.resolve(arm_reference.link_meshes)}
            )
        return arm_reference, description_problems(document, arm_reference, ("arm",))
    if arm_reference is None:
        try:
            return arm_of_driver(driver, settings), []
        except InputError as error:
            return None, list(error.problems) or [document.problem(("robot", "settings", "model"), str(error))]
    path = document.resolve(arm_reference)
    if not files.there(path):
        return None, [document.problem(("arm",), f"expected the arm's file; there is no {path}")]
    try:
        return read_arm(path, files), []
    except InputError as error:
        return None, list(error.problems)


def arm_of_driver(driver: str, settings: Mapping[str, Any]) -> ArmDescription | None:
    """Return a driver's default arm; None for a driver that is not included with Coupole.

    Raises InputError if a UR's `model` has no description.
    """
    if driver == UR:
        return shipped_arm(str(settings.get("model", UR_MODEL)))
    name = ARMS_OF_DRIVERS.get(driver)
    return shipped_arm(name) if name else None
