"""Pages of thumbnails of a view's frames."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence

from nicegui import events, ui

from coupole.console.runs.frame_sheets import SheetFrame
from coupole.console.screens.parts import button, picture_address

PER_PAGE, _WIDTH_PX = 60, 160
_EMIT_CLICKED = """(e) => {
  const one = e.target.closest('[data-shot]');
  if (one) emit(one.dataset.shot);
}"""
_MARK = """for (const one of document.querySelectorAll('.sheet [data-shot]')) {
  if (one.dataset.shot === %r) one.setAttribute('aria-current', 'true');
  else one.removeAttribute('aria-current');
}"""


class ContactSheet:
    """Thumbnails that are loaded when they become visible."""

    def __init__(self, name: str, pick: Callable[[str], object]) -> None:
        """`pick` is called with the shot of the chosen thumbnail."""
        self._name, self._frames, self._page, self._current = name, list[SheetFrame](), 0, ""
        with ui.row().classes("bar"):
            self._before = button("Before", lambda: self._turn(-1), name="page-before", icon="chevron_left")
            self._where = ui.label("").props("role=status data-name=page")
            self._after = button("After", lambda: self._turn(1), name="page-after", icon="chevron_right")

        def on_choice(event: events.GenericEventArguments) -> object:
            return pick(str(event.args))

        self._sheet = ui.html("", sanitize=False).props("data-name=sheet").style("width:100%")
        self._sheet.on("click", on_choice, js_handler=_EMIT_CLICKED)

    def show(self, frames: Sequence[SheetFrame]) -> None:
        """Show these frames, from the first page."""
        self._frames, self._page = list(frames), 0
        self._draw()

    def mark(self, shot: str) -> None:
        """Mark the chosen frame, and show its page."""
        self._current = shot
        place = next((k for k, frame in enumerate(self._frames) if frame.shot == shot), None)
        if place is not None and place // PER_PAGE != self._page:
            self._page = place // PER_PAGE
            self._draw()
        ui.run_javascript(_MARK % shot)

    def _turn(self, by: int) -> None:
        self._page += by
        self._draw()

    def _draw(self) -> None:
        first = self._page * PER_PAGE
        page_frames = self._frames[first : first + PER_PAGE]
        pages = max(1, -(-len(self._frames) // PER_PAGE))
        self._where.text = f"page {self._page + 1} of {pages}, {len(self._frames)} frames"
        self._before.set_enabled(self._page > 0)
        self._after.set_enabled(self._page + 1 < pages)
        self._sheet.set_content(
            f'<div class="sheet">{"".join(map(self._thumbnail, page_frames))}</div>'
            if page_frames
            else '<p class="hint">No proven frame here.</p>'
        )

    def _thumbnail(self, frame: SheetFrame) -> str:
        here = ' aria-current="true"' if frame.shot == self._current else ""
        address = picture_address(self._name, frame.shot, _WIDTH_PX)
        return (
            f'<button type="button" data-shot="{html.escape(frame.shot)}"{here}>'
            f'<img loading="lazy" alt="" src="{address}"><span>{html.escape(frame.light)}</span></button>'
        )
