"""The picture of a plan: the cell from three sides, the camera's view of the object, and the refusals."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from coupole.geometry import look_at
from coupole.motion.occlusion import REACHED
from coupole.viewing import view_colours as colours
from coupole.viewing.view_canvas import Canvas, Lookout
from coupole.viewing.view_scene import Scene, Stop
from coupole.viewing.view_sight import sight_lines
from coupole.viewing.view_solids import Solid, disk

WIDTH_PX, HEIGHT_PX = 1800, 1300
_MARGIN, _HEADER, _STRIP = 16, 76, 316
_LEFT = 1120
_CAMERAS, _CAMERA_WIDTH = 4, 306
"""Largest number of views that are shown through the camera, and their width. Refused views are first, then others
at even intervals."""
_GHOST, _GHOST_TOOL, _MANY = 0.38, 0.8, 8
"""Opacity of arm and tool at a view, and the largest number of views with an arm. With more views only the tool is
drawn."""
_SUPPORT_THICKNESS_MM = 15.0
_ROUND = 36
_ROWS = 14
"""Number of lines of text beside the pictures."""


def write_picture(scene: Scene, path: Path) -> None:
    """Write the PNG."""
    from PIL import Image, ImageDraw

    sheet = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), "white")
    pen = ImageDraw.Draw(sheet)
    _header(pen, scene)
    strip_top = HEIGHT_PX - _STRIP
    height, right = strip_top - _HEADER - _MARGIN, WIDTH_PX - _LEFT - 3 * _MARGIN
    half, beside = (height - _MARGIN) // 2, _LEFT + 2 * _MARGIN
    for title, lookout, x, top in (
        ("the cell", _cell_lookout(scene, _LEFT, height), _MARGIN, _HEADER),
        ("from above", _flat_lookout(scene, right, half, above=True), beside, _HEADER),
        ("from the side", _flat_lookout(scene, right, half, above=False), beside, _HEADER + half + _MARGIN),
    ):
        _paste(sheet, pen, _cell_from(scene, lookout), (x, top), title)
    _legend(pen, (_MARGIN + 14, _HEADER + height - 14))
    pictures = _chosen_stops([stop for stop in scene.stops if stop.sight is not None])
    for k, stop in enumerate(pictures):
        _through_the_camera(sheet, pen, scene, stop, _MARGIN + k * (_CAMERA_WIDTH + _MARGIN), strip_top)
    _column(pen, scene, _MARGIN + len(pictures) * (_CAMERA_WIDTH + _MARGIN) + 8, strip_top)
    quarter = sheet.resize((sheet.width // 2, sheet.height // 2), Image.Resampling.NEAREST)
    colours = quarter.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=4)
    sheet.quantize(palette=colours, dither=Image.Dither.NONE).save(path, optimize=True)


# -- the cell -----------------------------------------------------------------------------------------------------


def _cell_lookout(scene: Scene, width: int, height: int) -> Lookout:
    """Return a viewpoint outside the dome, with a long focal length, so that the whole dome is in the picture."""
    radius_mm = float(np.linalg.norm(scene.leds_mm, axis=1).max())
    distance_mm = 4.0 * radius_mm
    eye = look_at((0, 0, 0.45 * radius_mm), distance_mm, -60.0, 18.0)
    scale = min(0.46 * width / radius_mm, 0.72 * height / radius_mm) * distance_mm
    return Lookout(eye, scale, width, height, perspective=True)


def _flat_lookout(scene: Scene, width: int, height: int, *, above: bool) -> Lookout:
    """Return a viewpoint without perspective, scaled to support and arm."""
    standing = [stop.joints_deg for stop in scene.stops]
    standing += [stop.clash.joints_deg for stop in scene.stops if stop.clash is not None]
    arms = [scene.arm(joints, around=8) for joints in (scene.home_deg, *standing) if joints is not None]
    radius_mm = scene.rig.support.diameter_mm / 2
    support = np.array([(x, y, 0.0) for x in (-radius_mm, radius_mm) for y in (-radius_mm, radius_mm)])
    points = np.concatenate([support, *(part.vertices_mm for arm in arms for part in arm)])
    low, high = points.min(axis=0), points.max(axis=0)
    eye = look_at((low + high) / 2, 5000.0, -90.0, 90.0 if above else 0.0)
    across, along = (high - low)[[0, 1] if above else [0, 2]]
    return Lookout(eye, 0.9 * min(width / across, height / along), width, height, perspective=False)


def _cell_from(scene: Scene, lookout: Lookout) -> Any:
    canvas = Canvas(lookout)
    support = disk("support", scene.rig.support.diameter_mm / 2, _SUPPORT_THICKNESS_MM)
    canvas.fill([support], [colours.SUPPORT])
    if scene.object_solid is not None:
        canvas.fill([scene.object_solid], [colours.OBJECT])
    home = scene.arm(scene.home_deg, _ROUND)
    colour = [colours.TOOL if part.name in scene.tool_names else colours.HOME for part in home]
    canvas.fill(home, colour, opacity=1.0 if lookout.perspective else 0.5)
    arms, tools, touching = _standing(scene)
    canvas.fill(touching, [colours.RED] * len(touching))
    _dots_of_leds(canvas, scene, lookout)
    canvas.fill(arms, [colours.ARM] * len(arms), opacity=_GHOST)
    canvas.fill(tools, [colours.TOOL] * len(tools), opacity=_GHOST_TOOL)
    for volume in scene.keep_out:
        is_touched = any(stop.clash and f"keep-out `{volume.name}`" in stop.clash.bodies for stop in scene.stops)
        canvas.fill([volume], [colours.RED if is_touched else colours.KEEP_OUT], opacity=0.08)
    for stop in scene.stops:
        canvas.line(stop.flange_way_mm, colours.FLANGE_WAY, 1.0)
        canvas.line(
            stop.camera_way_mm, colours.RED if stop.refusal else colours.CAMERA_WAY, 2.0, hidden_opacity=0.3
        )
        canvas.dots(stop.vias_mm, colours.CAMERA_WAY, 3.0)
        if stop.sight is not None:
            sight_colour = colours.RED if stop.refusal else colours.SIGHT
            for line_mm in sight_lines(stop.sight):
                canvas.line(line_mm, sight_colour, 1.0)
            canvas.line(stop.footprint_mm, sight_colour, 1.2, hidden_opacity=0.3)
    image = canvas.image()
    _labels(image, scene, lookout)
    return image


def _standing(scene: Scene) -> tuple[list[Solid], list[Solid], list[Solid]]:
    """Return the arm at the views: its links without the base, the tool, and bodies that would collide."""
    arms: list[Solid] = []
    tools: list[Solid] = []
    touching: list[Solid] = []
    for stop in scene.stops:
        for joints_deg, red in ((stop.joints_deg, ()), *((c.joints_deg, c.bodies) for c in [stop.clash] if c)):
            for part in [] if joints_deg is None else scene.arm(joints_deg, _ROUND):
                if part.name in red:
                    touching.append(part)
                elif part.name in scene.tool_names:
                    tools.append(part)
                elif part.name != "base" and (red or len(scene.stops) <= _MANY):
                    arms.append(part)
    return arms, tools, touching


def _dots_of_leds(canvas: Canvas, scene: Scene, lookout: Lookout) -> None:
    """Draw the LEDs. Those on the near side of the dome are faint, so that the inside is visible."""
    towards_eye = -lookout.world_from_eye[:3, 2]
    near_side = scene.leds_mm @ towards_eye > 0
    colour = np.where(scene.is_used[:, None], colours.of_share(scene.led_share), colours.UNUSED)
    for side, opacity in ((near_side, 0.3), (~near_side, 1.0)):
        canvas.dots(scene.leds_mm[side], colour[side], 3.2 if lookout.perspective else 2.2, opacity=opacity)


def _labels(image: Any, scene: Scene, lookout: Lookout) -> None:
    """Numbers at the camera's positions, and labels at collisions."""
    from PIL import ImageDraw

    pen = ImageDraw.Draw(image)
    for stop in scene.stops:
        if stop.sight is not None:
            at, _ = lookout.project(stop.sight.support_from_camera[:3, 3])
            x, y = at
            colour = colours.css(colours.RED if stop.refusal else colours.INK)
            pen.ellipse((x - 10, y - 10, x + 10, y + 10), "white", colour, 2)
            pen.text((x, y), str(stop.number), colour, _font(13), anchor="mm")
    for stop in scene.stops:
        if stop.clash is not None:
            parts = [p for p in scene.arm(stop.clash.joints_deg, 8) if p.name in stop.clash.bodies]
            if parts:
                at, _ = lookout.project(np.concatenate([part.vertices_mm for part in parts]).mean(axis=0))
                _write_with_halo(pen, at, f"{stop.number}: {stop.clash.words}", image.width)


def _write_with_halo(pen: Any, at: Any, words: str, width: int) -> None:
    font = _font(15)
    length = pen.textlength(words, font)
    x = min(max(4.0, at[0] - length / 2), max(4.0, width - length - 4))
    pen.text(
        (x, at[1] - 28), words, colours.css(colours.RED), font, anchor="lm", stroke_width=3, stroke_fill="white"
    )


# -- through the camera -------------------------------------------------------------------------------------------


def _through_the_camera(sheet: Any, pen: Any, scene: Scene, stop: Stop, left_px: int, top_px: int) -> None:
    """Draw the camera's picture in a view, with the object coloured by the share of LEDs that reach it."""
    assert stop.sight is not None
    width = min(_CAMERA_WIDTH, (_STRIP - 84) * stop.sight.width_px // stop.sight.height_px)
    height = width * stop.sight.height_px // stop.sight.width_px
    colour = colours.css(colours.RED if stop.refusal else colours.INK)
    _paste(sheet, pen, _seen_by(scene, stop, width, height), (left_px, top_px + 24), "", colour)
    pen.text((left_px, top_px + 16), f"{stop.number}  {stop.name}", colour, _font(15), anchor="ls")
    for row, words in enumerate(_words_on(scene, stop)):
        pen.text((left_px, top_px + height + 34 + 17 * row), words, colour, _font(12), anchor="lt")


def _chosen_stops(stops: list[Stop]) -> list[Stop]:
    """Return refused views first, then others at even intervals, in the order of visiting."""
    refusals = [stop for stop in stops if stop.refusal][:_CAMERAS]
    clear = [stop for stop in stops if not stop.refusal]
    room = min(len(clear), _CAMERAS - len(refusals))
    evenly = np.linspace(0, len(clear) - 1, room).round().astype(int)
    return sorted([*refusals, *(clear[k] for k in evenly)], key=lambda stop: stop.number)


def _seen_by(scene: Scene, stop: Stop, width: int, height: int) -> Any:
    assert stop.sight is not None
    scale = stop.sight.focal_px * width / stop.sight.width_px
    canvas = Canvas(
        Lookout(stop.sight.support_from_camera, scale, width, height, perspective=True), (0.93, 0.93, 0.94)
    )
    canvas.fill([disk("support", scene.rig.support.diameter_mm / 2, _SUPPORT_THICKNESS_MM)], [colours.SUPPORT])
    if scene.object_solid is not None:
        canvas.fill([scene.object_solid], [_lit(scene, stop)])
    if stop.joints_deg is not None:
        links = [part for part in scene.arm(stop.joints_deg, _ROUND) if part.name not in scene.tool_names]
        canvas.fill(links, [colours.ARM] * len(links))
    return canvas.image()


def _lit(scene: Scene, stop: Stop) -> Any:
    """Return colours of the object's faces, by the share of the plan's LEDs that reach them."""
    if stop.shadow is None or not scene.is_used.any():
        return np.array(colours.OBJECT)
    share = (stop.shadow.codes[:, scene.is_used] == REACHED).mean(axis=1)
    return colours.of_share(np.append(share, 0.0)[scene.patch_of_face])


def _words_on(scene: Scene, stop: Stop) -> list[str]:
    if stop.refusal:
        return textwrap.wrap(stop.refusal, 50)[:3]
    return scene.light_on(stop)


# -- words --------------------------------------------------------------------------------------------------------


def _header(pen: Any, scene: Scene) -> None:
    pen.text((_MARGIN, 34), scene.plan, colours.css(colours.INK), _font(30), anchor="ls")
    clear = [stop for stop in scene.stops if not stop.refusal]
    move_s = sum(stop.leg_s or 0.0 for stop in scene.stops)
    words = (
        f"on {scene.rig.name}: {len(scene.stops)} views, {len(clear)} of them clear, {move_s:.1f} s of motion, "
        f"{int(scene.is_used.sum())} of {len(scene.is_used)} LEDs"
    )
    if not scene.paths_checked:
        words += "; paths were not checked for collisions"
    pen.text((_MARGIN, 62), words, colours.css(colours.INK), _font(16), anchor="ls")
    if scene.refusals:
        many = "is refused" if len(scene.refusals) == 1 else f"is refused for {len(scene.refusals)} reasons"
        pen.text((WIDTH_PX - _MARGIN, 34), f"the plan {many}", colours.css(colours.RED), _font(24), anchor="rs")


def _column(pen: Any, scene: Scene, x: int, top: int) -> None:
    """Write text beside the pictures: the reasons of a refusal, or otherwise the views and the durations of their
    legs."""
    rows = [
        line
        for refusal in scene.refusals
        for line in textwrap.wrap(refusal, 68, subsequent_indent="    ", break_on_hyphens=False)
    ] or [
        f"{stop.number}  {stop.name}" + ("" if stop.leg_s is None else f":  {stop.leg_s:.1f} s")
        for stop in scene.stops
    ]
    colour = colours.css(colours.RED if scene.refusals else colours.INK)
    pen.text((x, top + 16), "refused" if scene.refusals else "legs", colour, _font(15), anchor="ls")
    if len(rows) > _ROWS:
        rows = [*rows[: _ROWS - 1], f"and {len(rows) - _ROWS + 1} more lines; the page has all of them"]
    for row, line in enumerate(rows):
        pen.text((x, top + 40 + 19 * row), line, colour, _font(14), anchor="ls")


def _legend(pen: Any, bottom_left: tuple[int, int]) -> None:
    """Draw the legend of the colours, upwards from a corner."""
    x, y = bottom_left
    for k in range(120):
        pen.line((x + k, y - 10, x + k, y), colours.css(colours.of_share(k / 119)))
    note = "LEDs: share of the visible surface that they reach, 0 to 100 %, mean of the views"
    pen.text((x + 130, y - 5), note, colours.css(colours.INK), _font(13), anchor="lm")
    for row, (colour, words) in enumerate(
        (
            (colours.SIGHT, "field of view, and its footprint"),
            (colours.CAMERA_WAY, "path of the camera; grey: of the flange"),
            (colours.TOOL, "camera and other parts on the flange"),
            (colours.ARM, "arm at the views"),
            (colours.HOME, "arm at home"),
        ),
        start=1,
    ):
        at = y - 4 - 20 * row
        pen.rectangle((x, at - 11, x + 18, at), colours.css(colour))
        pen.text((x + 26, at - 5), words, colours.css(colours.INK), _font(13), anchor="lm")


def _paste(
    sheet: Any, pen: Any, image: Any, at: tuple[int, int], title: str, colour: str = "rgb(190,194,200)"
) -> None:
    x, top = at
    sheet.paste(image, at)
    pen.rectangle((x - 1, top - 1, x + image.width, top + image.height), None, colour)
    pen.text((x + 10, top + 10), title, colours.css(colours.INK), _font(16), anchor="lt")


def _font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size)
