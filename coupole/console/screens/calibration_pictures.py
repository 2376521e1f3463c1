"""Pictures of the things on the support for each step of a calibration: plain drawings from above."""

from __future__ import annotations

_EMPTY = ""
_CARD = '<rect class="card" x="-42" y="-30" width="84" height="60" rx="2"/>'
_SQUARES = "".join(
    f'<rect class="ink" x="{-42 + 7 * column}" y="{-31.5 + 7 * row}" width="7" height="7"/>'
    for row in range(9)
    for column in range(12)
    if (row + column) % 2 == 0
)
_BOARD = f'<rect class="white" x="-45" y="-34.5" width="90" height="69"/>{_SQUARES}'
_TILE = (
    '<rect class="holder" x="-26" y="-26" width="52" height="52" rx="3"/>'
    '<rect class="white" x="-20" y="-20" width="40" height="40"/>'
)
_THINGS = {
    "darks": (_EMPTY, "an empty support in the dark", True),
    "response": (_CARD, "a grey card on the support", False),
    "flat-field": (_EMPTY, "an empty support", False),
    "charuco": (_BOARD, "a ChArUco board at the support's centre", False),
    "leds": (_EMPTY, "an empty support", False),
    "spectralon": (_TILE, "the white tile at the support's centre", False),
}


def support_svg(step: str) -> str:
    """Return an SVG of the support with the things that a step (by its name) needs."""
    thing, words, dark = _THINGS[step]
    return (
        f'<svg class="placed{" dark" if dark else ""}" viewBox="-80 -80 160 160" role="img" aria-label="{words}">'
        f'<circle class="support" r="74"/><path class="axes" d="M-74 0H74M0 -74V74"/>{thing}</svg>'
    )
