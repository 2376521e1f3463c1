"""The steps that calibrate a cell. Each says which pictures are acquired, what is on the support, and which
records are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

OBJECT: Mapping[str, Any] = {
    "kind": "sculpted_relief",
    "translation_mm": [6.0, -4.0, 0.5],
    "abc_deg": [25.0, 0.0, 0.0],
    "stickers": {"count": 24},
}
"""The object on a simulated cell's support for the mesh step. The simulated scanner scans it."""
MESH = "mesh"


@dataclass(frozen=True)
class Step:
    """One acquisition and the records that are made from it."""

    name: str
    """Name of the plan, and of its template."""
    stands: str
    """Text that tells the operator what to put on the support."""
    things: tuple[Mapping[str, Any], ...]
    """The same things for a simulated cell, which places them itself (`world.settings.things`)."""
    records: tuple[str, ...]


STEPS = (
    Step("darks", "nothing; close the dome, and switch off the light of the room", (), ("dark",)),
    Step("response", "a grey card", ({"kind": "grey_card"},), ("response",)),
    Step("flat-field", "nothing", (), ("flat-field",)),
    Step(
        "charuco",
        "the ChArUco board at the centre",
        ({"kind": "charuco_board", "square_mm": 16.0, "marker_mm": 9.6},),
        ("camera", "hand-eye"),
    ),
    Step("leds", "nothing", (), ("leds",)),
    Step("spectralon", "the white tile at the centre", ({"kind": "spectralon_tile"},), ("led-power",)),
    Step(MESH, "the scanned object with its stickers", (OBJECT,), (MESH,)),
)
BESIDE = (Step("glare", "the white card with black traps at the centre", ({"kind": "glare_target"},), ("glare",)),)
"""Steps that are not part of `calibrate all`."""
