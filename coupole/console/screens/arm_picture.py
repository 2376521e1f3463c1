"""The arm in its cell: drawings from the front and from above, and a model that can be turned."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from nicegui import ui
from numpy.typing import NDArray

from coupole.console.screens.parts import button, with_name
from coupole.plan.cell import Cell

Points = NDArray[np.float64]
_RADII_MM = (110.0, 110.0, 90.0, 80.0, 65.0, 60.0, 55.0, 60.0)
"""Radii for the drawing, from joint to joint, the last from the flange to the camera. The collision bodies have
others."""
_MARGIN_MM = 60.0
_INK, _WAY, _GOAL = "#e07b00", "#1c7ed6", "#7048e8"


class ArmPicture:
    """Shows postures in the support frame, where z is up."""

    def __init__(self, cell: Cell) -> None:
        support_from_base = np.linalg.inv(cell.rig.support.base_from_support.matrix())
        self._rotation, self._offset_mm = support_from_base[:3, :3], support_from_base[:3, 3]
        self._leds_mm = self._in_support(cell.leds.positions_mm)
        self._radius_mm = cell.rig.support.diameter_mm / 2
        most_mm = np.vstack([self._leds_mm, self._offset_mm]).max(axis=0)
        self._reach_mm = float(np.abs(self._leds_mm[:, :2]).max()) + _MARGIN_MM
        self._height_mm = float(most_mm[2]) + 2 * _MARGIN_MM
        self._arm_mm: Points | None = None
        self._way_mm: Points | None = None
        self._goal_mm: Points | None = None
        with ui.element("div").classes("arm-pictures"):
            self._front = self._projection("from the front", self._cell_svg((0, 2)))
            self._top = self._projection("from above", self._cell_svg((0, 1)))
        self._words = with_name(ui.label().classes("hint"), "posture")
        self._turned = button("Turn it in 3D", self._toggle, icon="3d_rotation", name="in-3d", kind="flat")
        self._place = ui.column().classes("cell")
        self._model: _Model | None = None

    def show(self, links_mm: Sequence[Any], base_from_camera: Sequence[Any]) -> None:
        """Show a posture: origins [8, 3] of the links in the base frame, mm, and the camera's pose."""
        camera_mm = np.array(base_from_camera)[:3, 3]
        arm_mm = self._in_support(np.vstack([np.array(links_mm), camera_mm]))
        if self._arm_mm is not None and np.abs(arm_mm - self._arm_mm).max() < 0.05:
            return
        self._arm_mm = arm_mm
        self._draw()
        x, y, z = arm_mm[-1]
        self._words.text = f"The camera is at x {x:.0f}, y {y:.0f}, z {z:.0f} mm above the support's centre."

    def show_way(self, camera_mm: Sequence[Any] = (), links_mm: Sequence[Any] = ()) -> None:
        """Show the camera's path [n, 3], mm, and the arm at its end [8, 3]; without them, no path is shown."""
        self._way_mm = self._in_support(np.array(camera_mm)) if len(camera_mm) else None
        goal_mm = [*links_mm, camera_mm[-1]] if len(camera_mm) else None
        self._goal_mm = self._in_support(np.array(goal_mm)) if goal_mm else None
        self._draw()

    def _in_support(self, base_mm: Points) -> Points:
        return np.asarray(base_mm @ self._rotation.T + self._offset_mm, dtype=np.float64)

    def _toggle(self) -> None:
        self._place.clear()
        if self._model is not None:
            self._model = None
            self._turned.set_text("Turn it in 3D")
            return
        with self._place:
            self._model = _Model(self._leds_mm, self._radius_mm)
            ui.label("Drag to turn, use the wheel to zoom; the drawings above show the same.").classes("hint")
        self._turned.set_text("Close the 3D model")
        self._draw()

    # -- drawings -----------------------------------------------------------------------------------------------

    def _projection(self, words: str, still: str) -> ui.html:
        with ui.element("figure"):
            with ui.element("div").classes("arm-picture"):
                ui.html(still, sanitize=False)
                moving = ui.html("", sanitize=False).classes("over")
            ui.html(f"<figcaption>{html.escape(words)}</figcaption>", sanitize=False)
        return moving

    def _view_box(self, axes: tuple[int, int]) -> str:
        side_mm = 2 * self._reach_mm
        if axes[1] == 2:
            return f"{-self._reach_mm:.0f} {-self._height_mm:.0f} {side_mm:.0f} {self._height_mm + _MARGIN_MM:.0f}"
        return f"{-self._reach_mm:.0f} {-self._reach_mm:.0f} {side_mm:.0f} {side_mm:.0f}"

    def _cell_svg(self, axes: tuple[int, int]) -> str:
        dots = "".join(f"M{x:.0f} {-y:.0f}h0" for x, y in self._leds_mm[:, axes])
        disk = (
            f'<rect x="{-self._radius_mm:.0f}" y="0" width="{2 * self._radius_mm:.0f}" height="24" class="disk"/>'
            if axes[1] == 2
            else f'<circle r="{self._radius_mm:.0f}" class="disk"/>'
        )
        dome = f'<path d="{dots}" class="leds"/>'
        return f'<svg viewBox="{self._view_box(axes)}" aria-hidden="true">{disk}{dome}</svg>'

    def _draw(self) -> None:
        for picture, axes in ((self._front, (0, 2)), (self._top, (0, 1))):
            parts = []
            if self._goal_mm is not None:
                parts.append(_capsules(self._goal_mm[:, axes], "goal"))
            if self._arm_mm is not None:
                parts.append(_capsules(self._arm_mm[:, axes], "arm"))
            if self._way_mm is not None:
                line = " ".join(f"{x:.0f},{-y:.0f}" for x, y in self._way_mm[:, axes])
                parts.append(f'<polyline points="{line}" class="way"/>')
            picture.set_content(
                f'<svg viewBox="{self._view_box(axes)}" role="img" aria-label="the arm">{"".join(parts)}</svg>'
            )
        if self._model is not None:
            self._model.show(self._arm_mm, self._way_mm, self._goal_mm)


def _capsules(points_mm: Points, kind: str) -> str:
    lines = "".join(
        f'<line x1="{a[0]:.0f}" y1="{-a[1]:.0f}" x2="{b[0]:.0f}" y2="{-b[1]:.0f}" stroke-width="{radius:.0f}"/>'
        for a, b, radius in zip(points_mm[:-1], points_mm[1:], _RADII_MM, strict=True)
    )
    joints = "".join(f'<circle cx="{x:.0f}" cy="{-y:.0f}" r="16"/>' for x, y in points_mm[1:-1])
    x, y = points_mm[-1]
    return f'<g class="{kind}">{lines}{joints}<circle class="eye" cx="{x:.0f}" cy="{-y:.0f}" r="26"/></g>'


class _Model:
    """The same as a WebGL model, in metres; made only if it is wanted."""

    def __init__(self, leds_mm: Points, radius_mm: float) -> None:
        self._scene = ui.scene(grid=False, background_color="#eef1f4").classes("arm-model")
        self._scene.props('role=img aria-label="the arm in its cell, to be turned"')
        with self._scene as scene:
            scene.point_cloud((leds_mm / 1e3).tolist(), [[0.35, 0.4, 0.45]] * len(leds_mm), point_size=0.014)
            disk = scene.cylinder(radius_mm / 1e3, radius_mm / 1e3, 0.02, 48).material("#b8c2cc")
            disk.rotate(math.pi / 2, 0, 0).move(z=-0.01)
        scene.move_camera(x=1.2, y=-1.75, z=1.35, look_at_z=0.5, duration=0)
        self._moving: list[Any] = []

    def show(self, arm_mm: Points | None, way_mm: Points | None, goal_mm: Points | None) -> None:
        for shape in self._moving:
            shape.delete()
        self._moving = []
        with self._scene as scene:
            for points_mm, colour, opacity in ((goal_mm, _GOAL, 0.35), (arm_mm, _INK, 1.0)):
                if points_mm is not None:
                    self._capsules(scene, points_mm / 1e3, colour, opacity)
            for a, b in pairwise(way_mm / 1e3) if way_mm is not None else ():
                self._moving.append(scene.line(a.tolist(), b.tolist()).material(_WAY))

    def _capsules(self, scene: ui.scene, points: Points, colour: str, opacity: float) -> None:
        for a, b, radius_mm in zip(points[:-1], points[1:], _RADII_MM, strict=True):
            radius, length = radius_mm / 2e3, float(np.linalg.norm(b - a))
            self._moving.append(scene.sphere(radius, 16, 12).material(colour, opacity).move(*b))
            if length > 1e-4:
                link = scene.cylinder(radius, radius, length, 20).material(colour, opacity)
                self._moving.append(link.rotate_R(_along((b - a) / length).tolist()).move(*((a + b) / 2)))


def _along(direction: Points) -> Points:
    """Return a rotation that turns y, the axis of a cylinder, to a direction."""
    aside = np.cross(direction, [1.0, 0.0, 0.0] if abs(direction[0]) < 0.9 else [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    return np.stack([np.cross(direction, aside), direction, aside], axis=1)
