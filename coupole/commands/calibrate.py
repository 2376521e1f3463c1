"""`coupole calibrate NAME RUN...`: one command for each calibration."""

from __future__ import annotations

import typer

from coupole.commands import calibrate_colour, calibrate_geometry, calibrate_lens, calibrate_light, check_artefact
from coupole.commands.calibrate_all import calibrate_all

calibrate_app = typer.Typer(
    help="Calibrations: a record with uncertainties, and its report.", no_args_is_help=True
)
calibrate_app.command("camera")(calibrate_lens.camera)
calibrate_app.command("chromatic")(calibrate_lens.chromatic)
calibrate_app.command("hand-eye")(calibrate_lens.hand_eye)
calibrate_app.command("leds")(calibrate_geometry.leds)
calibrate_app.command("mesh")(calibrate_geometry.mesh)
calibrate_app.command("dark")(calibrate_light.dark)
calibrate_app.command("response")(calibrate_light.response)
calibrate_app.command("flat-field")(calibrate_light.flat_field)
calibrate_app.command("glare")(calibrate_light.glare)
calibrate_app.command("led-power")(calibrate_light.led_power)
calibrate_app.command("drift")(calibrate_light.drift)
calibrate_app.command("colour")(calibrate_colour.colour)
calibrate_app.command("check-artefact")(check_artefact.check_artefact)
calibrate_app.command("all")(calibrate_all)
