"""The dome as a picture: each LED at its direction, coloured by the brightness of its frame."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence

from nicegui import events, ui

from coupole.console.runs.frame_sheets import LedPlace, SheetFrame
from coupole.viewing.view_colours import css, of_share

_LARGEST, _EDGE = 0.05, 1.12
_RINGS_DEG = (0, 30, 60)
_EMIT_CLICKED = """(e) => {
  const one = e.target.closest('[data-shot]');
  if (one) emit(one.dataset.shot);
}"""
_EMIT_NEXT = """(e) => {
  const way = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]}[e.key];
  if (!way) return;
  e.preventDefault();
  e.stopPropagation();
  const all = [...e.currentTarget.querySelectorAll('circle[data-shot]')];
  const at = (one) => [one.cx.baseVal.value, one.cy.baseVal.value];
  const here = all.find(one => one.classList.contains('here'));
  const [x, y] = here ? at(here) : [0, 0];
  let best = null, least = Infinity;
  for (const one of all) {
    const [dx, dy] = [at(one)[0] - x, at(one)[1] - y];
    const ahead = dx * way[0] + dy * way[1], aside = Math.abs(dx * way[1] + dy * way[0]);
    if (one !== here && ahead > 1e-6 && ahead + 2.5 * aside < least) [best, least] = [one, ahead + 2.5 * aside];
  }
  if (best) emit(best.dataset.shot);
}"""
_MARK = """for (const one of document.querySelectorAll('.dome circle')) {
  const here = one.dataset.shot === %r;
  one.classList.toggle('here', here);
  if (here) one.parentNode.append(one);
}"""


class DomePicture:
    """The dome from above: the zenith in the middle, elevation 0 at the rim, the support's x to the right."""

    def __init__(self, pick: Callable[[str], object]) -> None:
        """`pick` is called with the shot of the chosen LED."""
        self._picture = ui.html("", sanitize=False).classes("dome").props("data-name=dome")

        def on_choice(event: events.GenericEventArguments) -> object:
            return pick(str(event.args))

        self._picture.on("click", on_choice, js_handler=_EMIT_CLICKED)
        self._picture.on("keydown", on_choice, js_handler=_EMIT_NEXT)

    def show(
        self, places: Mapping[int, LedPlace], frames: Sequence[SheetFrame], means: Mapping[str, float]
    ) -> None:
        """Show all LEDs; an LED with a frame has the colour of the frame's mean, a share of full scale."""
        self._picture.set_content(dome_svg(places, frames, means))

    def mark(self, shot: str) -> None:
        """Mark the LED of the chosen frame."""
        ui.run_javascript(_MARK % shot)


def dome_svg(places: Mapping[int, LedPlace], frames: Sequence[SheetFrame], means: Mapping[str, float]) -> str:
    """Return a polar picture, in which the distance from the middle is the angle from the zenith."""
    of_led = {frame.led: frame for frame in reversed(frames) if frame.led is not None}
    most = max((means[frame.shot] for frame in frames if frame.shot in means), default=0.0)
    radius = min(_LARGEST, 0.55 / math.sqrt(max(1, len(places))))
    rings = "".join(f'<circle class="ring" cx="0" cy="0" r="{1 - angle / 90:.3f}"/>' for angle in _RINGS_DEG)
    angles = "".join(f'<text x="0" y="{-(1 - angle / 90) + 0.025:.3f}">{angle}°</text>' for angle in _RINGS_DEG)
    leds = "".join(_led(led, place, of_led.get(led), means, most, radius) for led, place in places.items())
    side = 2 * _EDGE
    return (
        f'<svg viewBox="{-_EDGE} {-_EDGE} {side} {side}" tabindex="0" role="group" '
        'aria-label="the dome from above; arrow keys go from LED to LED">'
        f'{rings}{leds}{angles}<text x="1.06" y="0.025">x</text><text x="0" y="-1.05">y</text></svg>{_scale(most)}'
    )


def _led(
    led: int, place: LedPlace, frame: SheetFrame | None, means: Mapping[str, float], most: float, radius: float
) -> str:
    far, angle = 1 - place.elevation_deg / 90, math.radians(place.azimuth_deg)
    at = f'cx="{far * math.cos(angle):.4f}" cy="{-far * math.sin(angle):.4f}"'
    if frame is None:
        return f'<circle class="none" {at} r="{radius * 0.35:.4f}"><title>LED {led}: no frame</title></circle>'
    mean = means.get(frame.shot)
    words = f"LED {led}" + ("" if mean is None else f": {mean:.1%} of full scale")
    look = 'class="unread"' if mean is None else f'fill="{css(of_share(mean / most if most > 0 else 0.0))}"'
    shot = html.escape(frame.shot)
    return f'<circle {at} r="{radius:.4f}" {look} data-shot="{shot}"><title>{words}</title></circle>'


def _scale(most: float) -> str:
    if not most:
        return ""
    stops = ",".join(css(of_share(k / 8)) for k in range(9))
    return (
        f'<div class="scale"><span>0</span><i style="background:linear-gradient(to right,{stops})"></i>'
        f"<span>{most:.1%} of full scale, mean of the frame</span></div>"
    )
