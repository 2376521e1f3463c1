"""One frame, large: its picture, RAW histogram, clipping, exposure, pose and temperature."""

from __future__ import annotations

import html
from collections.abc import Callable

from nicegui import ui

from coupole.console.runs.run_files import Frame
from coupole.console.screens.parts import (
    button,
    clipping_words,
    facts_html,
    histogram_svg,
    picture_address,
)
from coupole.console.screens.visit import Visit, in_thread
from coupole.errors import CoupoleError

_WIDTH_PX = 1280


class FrameViewer:
    """The chosen frame, and buttons for its neighbours."""

    def __init__(self, visit: Visit, name: str, step: Callable[[int], object]) -> None:
        """`step` is called with -1 or 1."""
        self._visit, self._name, self._shot = visit, name, ""
        with ui.row().classes("bar"):
            button("", lambda: step(-1), name="previous", icon="chevron_left").props('aria-label="previous frame"')
            button("", lambda: step(1), name="next", icon="chevron_right").props('aria-label="next frame"')
            self._title = ui.label("").classes("frame-title").props("role=status data-name=frame")
            ui.label("also by the arrow keys").classes("hint")
            self._clipped = ui.checkbox("clipped in red", value=True, on_change=self._draw)
        self._picture = ui.html("", sanitize=False).style("width:100%")
        self._histogram = ui.html("", sanitize=False).style("width:100%")
        self._facts = ui.html("", sanitize=False).style("width:100%").props("data-name=frame-facts")
        with ui.expansion("Numbers").classes("printed"):
            self._numbers = ui.html("", sanitize=False).style("width:100%")

    async def show(self, shot: str, light: str) -> None:
        """Show a proven shot of the run."""
        self._shot = shot
        self._title.text = f"{light} · {shot}"
        self._draw()
        try:
            frame = await in_thread(self._visit.service.runs.frame, self._name, shot)
        except CoupoleError as error:
            self._facts.set_content(f'<p class="bad">{html.escape(str(error))}</p>')
            return
        if self._shot == shot:
            self._show(frame)

    def _draw(self) -> None:
        if self._shot:
            address = picture_address(self._name, self._shot, _WIDTH_PX, saturation=bool(self._clipped.value))
            self._picture.set_content(
                f'<img class="frame-picture large" src="{address}" alt="frame {html.escape(self._shot)}">'
            )

    def _show(self, frame: Frame) -> None:
        pose = ", ".join(f"{angle:.2f}" for angle in frame.joints_deg)
        self._histogram.set_content(histogram_svg(frame.figures.histograms))
        self._facts.set_content(
            facts_html(
                {
                    "exposure": f"{frame.exposure_us / 1000:g} ms",
                    "brightest": f"{frame.figures.brightest:.0%} of full scale",
                    **clipping_words(frame.figures.saturated),
                    "LED board": f"{frame.board_c:.1f} C",
                    "arm's joints": f"{pose} deg" if pose else "no arm",
                }
            )
        )
        self._numbers.set_content(
            facts_html(
                {
                    "LED current": f"{frame.current_ma} mA",
                    "camera's frame id": str(frame.frame_id),
                    "trigger": f"{frame.t_trigger_ns / 1e9:.6f} s by the LED box's clock",
                    "black and white": f"{frame.coding.black_dn} and {frame.coding.white_dn} DN",
                    "colour filters": frame.coding.pattern,
                    "sharpness": f"{frame.figures.sharpness:.4f}; comparable under the same light only",
                }
            )
        )
