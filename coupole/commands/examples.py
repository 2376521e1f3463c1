"""Two examples of each command, printed at the end of its help; a test parses each of them."""

from __future__ import annotations

from typing import Any

EXAMPLES: dict[str, tuple[str, str]] = {
    # plan and acquire
    "plan": ("plan new first", "plan new lights --template leds --rig sim"),
    "plan new": ("plan new first", "plan new lights --template leds --rig sim"),
    "plan suggest": (
        "plan suggest vase.ply --centre --material glossy --budget 4h --dose 200",
        "plan suggest vase.ply --rig my-cell.yaml --calibrations records --name vase-2026",
    ),
    "schema": ("schema plan", "schema rig"),
    "check": ("check first.yaml", "check first.yaml --no-paths --json"),
    "view": ("view first.yaml --show", "view first.yaml --out drawn --no-paths"),
    "simulate": ("simulate first.yaml --frames 12", "simulate first.yaml --frames 3 --width 400 --out frames"),
    "meter": ("meter first.yaml", "meter first.yaml --snr 50 --write metered.yaml"),
    "acquire": ("acquire first.yaml --reflectance", "acquire --resume RUN"),
    "demo": ("demo --open", "demo my-demo --short"),
    "example": ("example statue", "example statue my-statue"),
    # cell
    "devices": ("devices --rig sim", "devices --rig my-cell.yaml --json"),
    "doctor": ("doctor --rig sim", "doctor --rig my-cell.yaml --seconds 60"),
    "live": ("live sim --led 417", "live RUN --fps 5"),
    "arm": ("arm sim home", "arm sim view first.yaml top"),
    "bench": ("bench sim", "bench sim --object first.yaml --leave-after-s 3600"),
    "commission": (
        'commission my-cell.yaml --name "Your Name"',
        'commission my-cell.yaml --name "Your Name" --only cycle',
    ),
    "confirm": (
        'confirm my-cell.yaml --name "Your Name"',
        'confirm my-cell.yaml --name "Your Name" --note "cable replaced"',
    ),
    "sim": ("sim sim", "sim sim-gige --speed 4"),
    "serve": ("serve sim", "serve my-cell.yaml --port 8700 --plans plans"),
    "queue": ("queue my-cell.yaml first.yaml second.yaml", "queue my-cell.yaml --hold 'turn the object'"),
    "dose": ("dose gilded-frame", 'dose gilded-frame --add 120 --note "a week in the window"'),
    # calibrate
    "calibrate": ("calibrate all --rig sim", "calibrate colour PICTURES --chart chart.yaml"),
    "calibrate camera": ("calibrate camera RUN", "calibrate camera PICTURES --board 11x8 --square 20"),
    "calibrate chromatic": ("calibrate chromatic RUN", "calibrate chromatic RUN --out records --name colours"),
    "calibrate hand-eye": (
        "calibrate hand-eye RUN --camera camera.yaml",
        "calibrate hand-eye RUN --repeatability-mm 0.02",
    ),
    "calibrate leds": (
        "calibrate leds RUN --hand-eye hand-eye.yaml",
        "calibrate leds RUN --hand-eye hand-eye.yaml --tolerance-mm 5",
    ),
    "calibrate mesh": (
        "calibrate mesh RUN --scan SCAN --hand-eye hand-eye.yaml",
        "calibrate mesh RUN --scan SCAN --hand-eye hand-eye.yaml --scanner-mm 0.05",
    ),
    "calibrate dark": ("calibrate dark RUN", "calibrate dark RUN --valid-days 30"),
    "calibrate response": ("calibrate response RUN", "calibrate response RUN --dark dark.yaml"),
    "calibrate flat-field": (
        "calibrate flat-field RUN --dark dark.yaml",
        "calibrate flat-field RUN --response response.yaml --out records",
    ),
    "calibrate glare": (
        "calibrate glare RUN --target glare-target.yaml",
        "calibrate glare RUN --dark dark.yaml --response response.yaml --limit form=0.15",
    ),
    "calibrate led-power": (
        "calibrate led-power RUN --tile tile.yaml",
        "calibrate led-power RUN --tile tile.yaml --flat flat-field.yaml",
    ),
    "calibrate drift": (
        "calibrate drift RUN --tile tile.yaml --led-power led-power.yaml",
        "calibrate drift RUN --tile tile.yaml --led-power led-power.yaml --valid-days 7",
    ),
    "calibrate colour": (
        "calibrate colour RUN --chart chart.yaml",
        "calibrate colour PICTURES --chart chart.yaml --white white.tif",
    ),
    "calibrate check-artefact": (
        "calibrate check-artefact PLACE1 PLACE2 --board second-board.yaml --records records --mpe-um 50+L/20",
        "calibrate check-artefact RUN --tile second-tile.yaml --records records",
    ),
    "calibrate all": ("calibrate all --rig sim", "calibrate all --rig my-cell.yaml --only charuco --yes"),
    "certificate": (
        "certificate calibrations --about certificate.yaml",
        "certificate calibrations --about certificate.yaml --earlier last-year --out cell.html",
    ),
    "budget": ("budget camera.yaml hand-eye.yaml leds.yaml", "budget --plan first.yaml --out budget.png"),
    # results and bench
    "reflectance": (
        "reflectance RUN --out result",
        "reflectance --pictures PICTURES --lights lights.lp --out result",
    ),
    "reflectance from": (
        "reflectance RUN --out result --texels 0.2",
        "reflectance --pictures PICTURES --lights lights.lp --out result",
    ),
    "reflectance extract": ("reflectance extract RUN --out result", "reflectance extract RUN RUN2 --out result"),
    "reflectance fit": ("reflectance fit RESULT", "reflectance fit RESULT --memory 4GB"),
    "reflectance check": ("reflectance check RESULT", "reflectance check RESULT --json"),
    "reflectance ablate": ("reflectance ablate RESULT", "reflectance ablate RESULT RUN --texels"),
    "reflectance cluster": (
        "reflectance cluster RESULT --clusters 40",
        "reflectance cluster RESULT --texels --clusters 12",
    ),
    "reflectance choose": (
        "reflectance choose --pictures PICTURES --lights lights.lp --count 16",
        "reflectance choose --pictures PICTURES --lights lights.lp --count 40 --until 0.02 --to chosen.json",
    ),
    "reflectance refine": (
        "reflectance refine RUN --out refined",
        "reflectance refine RUN RUN2 --out refined --arm-mm 0.2",
    ),
    "reflectance relight": (
        "reflectance relight RESULT --direction 0.3,0.2,1 --to lit.png",
        "reflectance relight RESULT --light-at 100,-200,300 --to lit.exr --uncertainty u.exr",
    ),
    "verify": ("verify RUN", "verify RUN --json"),
    "archive": ("archive RUN", "archive RUN --keep"),
    "identify": (
        "identify spot.csv --library KremerHistorical.rs",
        "identify painting.hdr --library KremerHistorical.rs --report seen",
    ),
    "compare": (
        "compare before.ply after.ply --out changes",
        "compare RESULT RESULT2 --out changes --noise-mm 0.05",
    ),
    "register": ("register 1.ply 2.ply 3.ply --out merged", "register room.e57 --out merged --no-mesh"),
    "scan": ("scan bust.ply --out bust", "scan bust.ply --targets targets.csv --unit m --out bust"),
    "layer": (
        "layer samples.csv --thickness-um 25 --out K-and-S",
        "layer --over-black black.csv --over-white white.csv --black ground-black.csv --white ground-white.csv",
    ),
    "recipe": ("recipe wanted.csv --palette paints", "recipe wanted.csv --palette paints --light D65 --at-most 3"),
    "bracket": (
        "bracket 1.dng 2.dng 3.dng --out merged.exr",
        "bracket 1.tif 2.tif --linear --exposure-s 0.01 --exposure-s 0.04 --out merged.exr",
    ),
    "sphere-brdf": (
        "sphere-brdf sample.yaml --out finish.binary",
        "sphere-brdf sample.yaml --out finish.binary --json",
    ),
    "makie": (
        "makie box.png --metal 210,80 --lacquer 40,300 --out drawing.png",
        "makie box.png --metal 210,80 --lacquer 40,300 --lacquer 400,320 --out drawing.png",
    ),
    # look and share
    "show": ("show RESULT --out page.html", "show RUN --out frames.html --view top"),
    "export": ("export RESULT --to gltf --out for-blender", "export RUN --to dng --shots 'led04*/e0'"),
    "render": ("render scene.yaml", "render scene.yaml --samples 64 --width 300 --out rendered"),
    "restore": (
        "restore bust.ply --parts parts.yaml --materials bust.yaml --out restored",
        "restore pick bust.ply --out parts.html",
    ),
    "restore from": (
        "restore bust.ply --parts parts.yaml --materials bust.yaml --out restored",
        "restore bust.ply --parts parts.yaml --materials bust.yaml --width 400 --out restored",
    ),
    "restore pick": ("restore pick bust.ply", "restore pick bust.ply --materials bust.yaml --out parts.html"),
    # runs
    "status": ("status", "status RUN --follow"),
    "pause": ("pause", "pause RUN"),
    "go-on": ("go-on", "go-on RUN"),
    "stop": ("stop", "stop RUN"),
    "report": ("report RUN", "report RUN --out report.html"),
}
"""Examples of a command, without the word `coupole`. The key is the command's name, or the names of its group and
step.

RUN, RESULT, WHITE (a run with a white sheet) and PICTURES stand for folders, and SCAN stands for a folder of
`coupole scan`.
"""

HEADING = "Examples:"


def add_examples(command: Any, name: str) -> None:
    """Add the examples to the end of a command's help, and of the help of its steps."""
    if name not in EXAMPLES:
        raise LookupError(f"coupole/commands/examples.py: expected two examples of `coupole {name}` in EXAMPLES")
    command.epilog = "\n\n".join([HEADING, *(f"coupole {example}" for example in EXAMPLES[name])])
    for step in getattr(command, "commands", {}).values():
        add_examples(step, f"{name} {step.name}")
