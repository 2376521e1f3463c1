"""The bench's newest picture with gridlines and a region, and a loupe."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from nicegui import events, ui

from coupole.console.screens.parts import with_name
from coupole.console.screens.visit import Visit, in_thread
from coupole.errors import CoupoleError

_LOUPE_PX = (200, 150)
_LOOK = Path(__file__).parent / "look.js"


class LookPicture:
    """The picture. Dragging on it draws a region; a click opens the loupe at that point."""

    def __init__(self, visit: Visit, on_region: Callable[[list[int]], object]) -> None:
        """`on_region` is called with x, y, width and height, in pixels of the sensor."""
        self._visit, self._bench, self._on_region = visit, visit.service.bench, on_region
        sensor = visit.service.cell.rig.sensor
        self._size_px = sensor.width_px, sensor.height_px
        self._region: Sequence[int] | None = None
        self._grid, self._number = True, 0
        self._gains: Sequence[float] = (1.0, 1.0, 1.0)
        ui.add_body_html(f"<script>{_LOOK.read_text(encoding='utf-8')}</script>")
        width, height = self._size_px
        with ui.element("div").classes("look") as self._look:
            self._look.props(f"data-width={width} data-height={height} data-name=look")
            self._look.style(f"aspect-ratio:{width}/{height}")
            self._image = ui.element("img").props('alt="No picture yet"').classes("look-picture")
            self._over = ui.html("", sanitize=False).classes("over")
        self._look.on("picked", self._on_pick, js_handler="(e) => emit(e.detail)")
        self._draw()

    def build_loupe(self) -> None:
        """Build the element that shows the loupe."""
        self._loupe = with_name(ui.html("", sanitize=False), "loupe").classes("loupe")
        self._loupe.set_content('<p class="hint">Click on the picture: each pixel of the sensor is one here.</p>')

    def show(self, picture: dict[str, Any], gains: Sequence[float]) -> None:
        """Show a picture that the bench has taken."""
        self._number, self._gains = picture["number"], gains
        name = Path(picture["picture"]).name
        self._image.props(
            f'src="/api/v1/bench/pictures/{name}?{picture["number"]}" alt="picture {picture["number"]}"'
        )
        self._look.props(f"data-picture={picture['number']}")

    def set_grid(self, is_shown: bool) -> None:
        self._grid = is_shown
        self._draw()

    def set_region(self, region: Sequence[int] | None) -> None:
        self._region = region
        self._draw()

    async def loupe(self, at_px: Sequence[int] | None = None) -> None:
        """Show the last picture through the loupe at a point; by default in the middle of the region, or of the
        picture."""
        if not self._number:
            return
        x, y, width, height = self._region or (0, 0, *self._size_px)
        middle = at_px or (x + width // 2, y + height // 2)
        part_px = [min(loupe, size) for loupe, size in zip(_LOUPE_PX, self._size_px, strict=True)]
        corner = [
            max(0, min(size - part, at - part // 2))
            for at, part, size in zip(middle, part_px, self._size_px, strict=True)
        ]
        try:
            picture = await in_thread(
                self._bench.ask, "loupe", region=[*corner, *part_px], gains=list(self._gains)
            )
        except CoupoleError as error:
            self._visit.say(str(error), bad=True)
            return
        left_px, top, width, height = picture["region"]
        source = f"/api/v1/bench/pictures/loupe.png?{picture['number']}-{left_px}-{top}"
        self._loupe.set_content(
            f'<img src="{source}" alt="loupe into picture {picture["number"]} at {left_px}, {top}">'
            f'<p class="hint">{width} x {height} px of picture {picture["number"]}, from {left_px}, {top}</p>'
        )

    async def _on_pick(self, event: events.GenericEventArguments) -> None:
        selection = event.args
        if "region" in selection:
            self._on_region([int(value) for value in selection["region"]])
        else:
            await self.loupe([int(value) for value in selection["point"]])

    def _draw(self) -> None:
        width, height = self._size_px
        lines = []
        if self._grid:
            across = "".join(f"M{width * k / 3:.1f} 0V{height}M0 {height * k / 3:.1f}H{width}" for k in (1, 2))
            middle = f"M{width * 0.48:.1f} {height / 2}H{width * 0.52:.1f}"
            cross = f"{middle}M{width / 2} {height * 0.47:.1f}V{height * 0.53:.1f}"
            lines.append(f'<path class="gridline" d="{across}{cross}"/>')
        if self._region:
            x, y, wide, high = self._region
            lines.append(f'<rect class="region" x="{x}" y="{y}" width="{wide}" height="{high}"/>')
        self._over.set_content(
            f'<svg viewBox="0 0 {width} {height}" preserveAspectRatio="none" aria-hidden="true">{"".join(lines)}'
            '<rect class="band" x="0" y="0" width="0" height="0"/></svg>'
        )
