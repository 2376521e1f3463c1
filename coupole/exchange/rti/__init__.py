"""Views under many lights for programs that relight pictures (RTI), and for viewers of pictures."""

FORMATS = {
    "lp": "pictures under each LED with directions, for programs that fit them",
    "dome": "relight's file of the LEDs' places",
    "relight": "relight's planes of coefficients for browsers (OpenLIME)",
    "ptm": "a polynomial texture map, PTM 1.2 LRGB",
    "rti": "hemispherical harmonics, HSH 1.2",
    "iiif": "IIIF: a manifest and tiled pictures",
}
OF_RUNS_ONLY = ("lp", "dome")
"""What needs the LEDs of a run."""
