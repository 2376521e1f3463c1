"""`coupole calibrate NAME RUN...`: one command for each calibration."""

from __future__ import annotations

import typer

from coupole.commands import calibrate_lens

calibrate_app = typer.Typer(
    help="Calibrations: a record with uncertainties, and its report.", no_args_is_help=True
)
calibrate_app.command("camera")(calibrate_lens.camera)
calibrate_app.command("hand-eye")(calibrate_lens.hand_eye)
