"""The interactive page of a plan: the cell in 3D, view by view. It is one file that needs no network."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.motion.occlusion import AWAY, BY_ARM, BY_OBJECT, BY_TOOL
from coupole.pages.page_parts import Code, Inline, Link, Page, Section, Verdict
from coupole.pages.page_rendering import render
from coupole.viewing import view_colours as colours
from coupole.viewing.terminal import duration_text
from coupole.viewing.view_colours import Colour, css
from coupole.viewing.view_scene import Scene, Stop
from coupole.viewing.view_sight import sight_lines
from coupole.viewing.view_solids import Points, Solid, disk, join_solids, with_fewer_faces

_OBJECT_FACES = 30_000
_ROUND = 12
_MANY = 8
"""Largest number of views for which the arm is shown in several views at a time."""
_SUPPORT_THICKNESS_MM = 15.0
_OVERVIEW, _ALWAYS = 0, -1
"""Steps of the slider in addition to the views' numbers: the overview, and all steps."""

_SCRIPT = """
const steps = %s, slider = document.getElementById("step");
function show() {
  const step = steps[+slider.value];
  slider.setAttribute("aria-valuetext", step.name);
  document.getElementById("view").innerHTML = step.words;
  Plotly.restyle("{plot_id}", {visible: step.visible});
}
slider.addEventListener("input", show);
show();
"""
"""Script of the slider; `{plot_id}` is replaced by Plotly."""
_BUTTONS = [["toImage"], ["orbitRotation", "tableRotation", "pan3d", "zoom3d"], ["resetCameraDefault3d"]]
"""Buttons of the drawing. Buttons that would send the drawing to a server are left out."""


def write_page(scene: Scene, path: Path) -> None:
    """Write the HTML page, with plotly.js in it. Raises OSError."""
    figure, steps = _figure(scene)
    drawing = figure.to_html(
        full_html=False,
        include_plotlyjs=True,
        default_height="75vh",
        config={"displaylogo": False, "responsive": True, "modeBarButtons": _BUTTONS},
        post_script=_SCRIPT % json.dumps(steps).replace("<", "\\u003c"),
    )
    page = render(_words_of(scene), "plan.html", drawing=drawing, last_step=len(scene.stops))
    path.write_text(page, encoding="utf-8")


def _words_of(scene: Scene) -> Page:
    views = "1 view" if len(scene.stops) == 1 else f"{len(scene.stops)} views"
    clear = sum(not stop.refusal for stop in scene.stops)
    paths_remark = "" if scene.paths_checked else " Paths were not checked for collisions."
    next_step: Inline = ["Take its frames: ", Code(f"coupole acquire {scene.plan}.yaml")]
    if scene.refusals:
        next_step = ["Read ", Link("#refusals", "why the plan is refused"), ", and change these views."]
    return Page(
        title=f"{scene.plan}: {views} planned",
        pictures=[],
        summary=f"Postures and paths of {views} were planned on {scene.rig.name}.",
        quality=f"{clear} of {len(scene.stops)} views are clear.{paths_remark}",
        next_step=next_step,
        sections=[
            Section(
                "refusals", "The plan is refused", items=[Verdict(refusal, "bad") for refusal in scene.refusals]
            )
        ],
    )


def _figure(scene: Scene) -> tuple[Any, list[dict[str, Any]]]:
    """Return the drawing, and for each step of the slider its visible parts, name and words in HTML."""
    import plotly.graph_objects as go

    step_traces: list[tuple[int, Any]] = [(_ALWAYS, trace) for trace in _cell(scene)]
    step_traces.append((_OVERVIEW, _leds(scene, scene.led_share, None)))
    few = len(scene.stops) <= _MANY
    for stop in scene.stops:
        step_traces += [(_ALWAYS, trace) for trace in _ways(stop)]
        for step in (_OVERVIEW, stop.number):
            step_traces += [(step, trace) for trace in _camera(scene, stop)]
            if step == stop.number or few or stop.clash is not None:
                step_traces += [
                    (step, trace) for trace in _arm(scene, stop, opacity=0.3 if step == _OVERVIEW else 1.0)
                ]
        share = np.zeros(len(scene.leds_mm)) if stop.shadow is None else stop.shadow.share()
        step_traces.append((stop.number, _leds(scene, share, stop)))
    traces = [trace.update(visible=step in (_ALWAYS, _OVERVIEW)) for step, trace in step_traces]
    titles = ["all views", *(_title(scene, stop) for stop in scene.stops)]
    names = ["all views", *(f"{stop.number} {stop.name}" for stop in scene.stops)]
    steps = [
        {"name": name, "words": words, "visible": [step in (_ALWAYS, k) for step, _ in step_traces]}
        for k, (name, words) in enumerate(zip(names, titles, strict=True))
    ]
    axis = {"showbackground": False, "gridcolor": "#dddddd", "zeroline": False}
    figure = go.Figure(
        traces,
        {
            "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
            "showlegend": False,
            "scene": {
                "aspectmode": "data",
                "camera": {"eye": {"x": 0.7, "y": -1.2, "z": 0.5}, "center": {"x": 0, "y": 0, "z": -0.15}},
                **{f"{name}axis": {**axis, "title": {"text": f"{name} (mm)"}} for name in "xyz"},
            },
        },
    )
    return figure, steps


def _title(scene: Scene, stop: Stop) -> str:
    return (
        f"<b>{stop.number} {stop.name}</b>: {escape(stop.refusal)}"
        if stop.refusal
        else _words_on(scene, stop).replace("<br>", "; ")
    )


def _words_on(scene: Scene, stop: Stop) -> str:
    """Text that is shown when the pointer is on a view."""
    words = [f"<b>{stop.number} {stop.name}</b>"]
    if stop.refusal:
        words.append(f"refused: {escape(stop.refusal)}")
    if stop.joints_deg is not None:
        words.append("axes " + ", ".join(f"{angle:.1f}" for angle in stop.joints_deg) + " deg")
    if stop.leg_s is not None:
        via = f" over {len(stop.vias_mm)} via points" if len(stop.vias_mm) else ""
        words.append(f"path of {duration_text(stop.leg_s)}{via}")
    words += scene.light_on(stop)
    return "<br>".join(words)


# -- traces -------------------------------------------------------------------------------------------------------


def _cell(scene: Scene) -> list[Any]:
    traces = [_mesh(disk("support", scene.rig.support.diameter_mm / 2, _SUPPORT_THICKNESS_MM), colours.SUPPORT)]
    if scene.object_solid is not None:
        traces.append(_mesh(with_fewer_faces(scene.object_solid, _OBJECT_FACES), colours.OBJECT))
    traces += [_mesh(volume, colours.KEEP_OUT, 0.1, f"keep-out {volume.name}") for volume in scene.keep_out]
    traces.append(_mesh(join_solids("arm at home", scene.arm(scene.home_deg, _ROUND)), colours.HOME, 0.25))
    if not scene.is_used.all():
        marker = {"size": 2, "color": css(colours.UNUSED)}
        traces.append(_points(scene.leds_mm[~scene.is_used], marker, "LED that the plan does not light"))
    return traces


def _arm(scene: Scene, stop: Stop, *, opacity: float) -> list[Any]:
    """Draw the arm at a view, red where it would collide."""
    traces = []
    if stop.joints_deg is not None:
        arm = scene.arm(stop.joints_deg, _ROUND)
        of_tool = _is(scene.tool_names)
        traces.append(_mesh(_joined_parts(arm, of_tool), colours.TOOL, opacity, _words_on(scene, stop)))
        traces.append(
            _mesh(_joined_parts(arm, lambda name: not of_tool(name)), colours.ARM, opacity, _words_on(scene, stop))
        )
    if stop.clash is not None:
        arm = scene.arm(stop.clash.joints_deg, _ROUND)
        touches = _is(stop.clash.bodies)
        red, rest = _joined_parts(arm, touches), _joined_parts(arm, lambda name: not touches(name))
        words = f"{stop.number} {stop.name}: {stop.clash.words}"
        traces += [_mesh(red, colours.RED, 1.0, words), _mesh(rest, colours.ARM, 0.3, words)]
        traces.append(_text(red.vertices_mm.mean(axis=0), stop.clash.words, colours.RED))
    return traces


def _is(names: frozenset[str] | tuple[str, ...]) -> Callable[[str], bool]:
    return lambda name: name in names


def _joined_parts(parts: Sequence[Solid], is_wanted: Callable[[str], bool]) -> Solid:
    return join_solids("arm", [part for part in parts if is_wanted(part.name)])


def _ways(stop: Stop) -> list[Any]:
    colour = colours.RED if stop.refusal else colours.CAMERA_WAY
    words = f"path of the camera to {stop.number} {stop.name}"
    traces = [_line([stop.camera_way_mm], colour, 4, words)]
    traces.append(_line([stop.flange_way_mm], colours.FLANGE_WAY, 2, words.replace("camera", "flange")))
    if len(stop.vias_mm):
        traces.append(_points(stop.vias_mm, {"size": 4, "color": css(colour)}, "via point"))
    return traces


def _camera(scene: Scene, stop: Stop) -> list[Any]:
    if stop.sight is None:
        return []
    colour = colours.RED if stop.refusal else colours.SIGHT
    words = _words_on(scene, stop)
    return [
        _line([*sight_lines(stop.sight), stop.footprint_mm], colour, 3, words),
        _text(stop.sight.support_from_camera[:3, 3], str(stop.number), colour, words),
    ]


def _leds(scene: Scene, share: NDArray[np.float64], stop: Stop | None) -> Any:
    """Draw the LEDs of the plan, coloured by the share that they reach. In a view, the text at each LED has the
    causes of occlusion.
    """
    columns = [scene.led_ids, share]
    hover = "LED %{customdata[0]:.0f}: reaches %{customdata[1]:.0%} of the visible surface"
    if stop is not None and stop.shadow is not None:
        columns += [stop.shadow.share(code) for code in (AWAY, BY_OBJECT, BY_ARM, BY_TOOL)]
        hover += "<br>turned away from %{customdata[2]:.0%}; hidden by the object %{customdata[3]:.0%}, "
        hover += "by the arm %{customdata[4]:.0%}, by the tool %{customdata[5]:.0%}"
    marker = {
        "size": 3.5,
        "color": share[scene.is_used].astype(np.float32),
        "cmin": 0,
        "cmax": 1,
        "colorscale": [[k / 8, css(colours.of_share(k / 8))] for k in range(9)],
        "showscale": True,
        "colorbar": {"title": {"text": "reached"}, "tickformat": ".0%", "len": 0.5, "thickness": 12},
    }
    told_of = np.stack(columns, axis=1)[scene.is_used].astype(np.float32)
    trace = _points(scene.leds_mm[scene.is_used], marker, hover)
    return trace.update(customdata=told_of)


def _mesh(solid: Solid, colour: Colour, opacity: float = 1.0, words: str = "") -> Any:
    import plotly.graph_objects as go

    x, y, z = solid.vertices_mm.astype(np.float32).T
    i, j, k = solid.faces.astype(np.uint16 if len(solid.vertices_mm) < 65536 else np.uint32).T
    return go.Mesh3d(
        x=x,
        y=y,
        z=z,
        i=i,
        j=j,
        k=k,
        color=css(colour),
        opacity=opacity,
        flatshading=False,
        lighting={"ambient": 0.55, "diffuse": 0.6, "specular": 0.1},
        hovertemplate=(words or solid.name) + "<extra></extra>",
    )


def _line(lines_mm: Sequence[Points], colour: Colour, width: int, words: str) -> Any:
    """Return several lines [n, 3] as one trace, with gaps between them."""
    gap = np.full((1, 3), np.nan)
    points = np.concatenate([part for line in lines_mm for part in (line, gap)])
    trace = _points(points, None, words)
    return trace.update(mode="lines", line={"color": css(colour), "width": width})


def _points(points_mm: Points, marker: dict[str, Any] | None, words: str) -> Any:
    import plotly.graph_objects as go

    x, y, z = points_mm.astype(np.float32).T
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, hovertemplate=words + "<extra></extra>")


def _text(at_mm: Points, text: str, colour: Colour, words: str = "") -> Any:
    trace = _points(at_mm[None], None, words or text)
    return trace.update(mode="text", text=[text], textfont={"color": css(colour), "size": 15})
