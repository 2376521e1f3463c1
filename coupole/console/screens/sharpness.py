"""Sharpness while a person turns the lens: the present value, the best so far, and their history."""

from __future__ import annotations

from nicegui import ui

from coupole.console.screens.parts import button, panel, with_name

_KEPT = 120


class Sharpness:
    """Values that can be compared, because they are of the same region under the same light."""

    def __init__(self) -> None:
        self._values: list[float] = []
        self._of: object = None
        with panel("Sharpness"):
            self._now = with_name(ui.label("-").classes("large-figure"), "sharpness")
            self._best = with_name(ui.label().classes("hint"), "best")
            self._chart = ui.html("", sanitize=False).style("width:100%")
            button("Begin anew", self.reset, icon="restart_alt", name="reset-best", kind="flat")
        self.reset()

    def add(self, value: float, of: object, words: str) -> None:
        """Add a picture's value; earlier values of other settings are forgotten."""
        if of != self._of:
            self._values, self._of = [], of
        self._values = [*self._values, value]
        best = max(self._values)
        share = f", {value / best:.0%} of the best so far" if best > 0 else ""
        self._now.text = f"{value:.4f}{share}" if value > 0 else "no more than noise"
        so_far = f"best so far {best:.4f}, " if best > 0 else ""
        self._best.text = f"{so_far}{words}; comparable under the same light only"
        self._chart.set_content(_chart(self._values[-_KEPT:], best))

    def reset(self) -> None:
        self._values = []
        self._now.text = "-"
        self._best.text = "Draw a region on what should be in focus, and turn the lens until this is largest."
        self._chart.set_content("")


def _chart(values: list[float], best: float) -> str:
    step, top = 100 / max(1, len(values) - 1), best or 1.0
    points = " ".join(f"{k * step:.2f},{30 - 28 * value / top:.2f}" for k, value in enumerate(values))
    return (
        '<svg viewBox="0 0 100 30" preserveAspectRatio="none" role="img" class="sharpness-chart" '
        f'aria-label="sharpness of the last {len(values)} pictures"><line x1="0" y1="2" x2="100" y2="2"/>'
        f'<polyline points="{points}"/></svg>'
    )
