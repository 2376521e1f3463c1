"""Plans to start from: `coupole plan new NAME`."""


def _board_views(count: int = 40) -> str:
    """Return views of a board at the support's centre, near the focus. They are tilted, rolled and shifted evenly
    (additive recurrence with the root of x^7 = x + 1; Roberts 2018)."""
    root = 1.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / 7.0)
    lines = []
    for number in range(1, count + 1):
        share = [(0.5 + number / root**k) % 1.0 for k in range(1, 7)]
        x_mm, y_mm = 70.0 * (share[0] - 0.5), 70.0 * (share[1] - 0.5)
        distance_mm, azimuth_deg = 335.0 + 40.0 * (share[2] - 0.25), 360.0 * share[3] - 180.0
        elevation_deg, roll_deg = 54.0 + 26.0 * share[4], 120.0 * (share[5] - 0.5)
        lines.append(
            f"  - {{{{kind: look_at, name: b{number:02d}, target_mm: [{x_mm:.1f}, {y_mm:.1f}, 5], "
            f"distance_mm: {distance_mm:.1f},\n     azimuth_deg: {azimuth_deg:.1f}, "
            f"elevation_deg: {elevation_deg:.1f}, roll_deg: {roll_deg:.1f}}}}}"
        )
    return "\n".join(lines)


LEDS = "leds"
"""A plan that is made for a rig's dome: `coupole.calibration.leds.led_plan`."""
TEMPLATES = {
    "views": """\
# yaml-language-server: $schema=plan.schema.json   (made by `coupole schema plan > plan.schema.json`)
schema_version: 1
name: {name}
rig: {rig}
object:
  id: {name}-object
  # mesh: ../objects/object.ply       # PLY, STL or OBJ
  # mesh_unit: mm                     # mm, m or um
  dose_budget_lux_h: 50
# calibrations: none                  # or records that must be in force, in place of those that the rig names
views:
  - {{kind: look_at, name: top, target_mm: [0, 0, 30], distance_mm: 335, azimuth_deg: -90, elevation_deg: 80}}
  - {{kind: grid, name: ring, target_mm: [0, 0, 30], distance_mm: 335, azimuths_deg: [0, 120, 240],
     elevations_deg: [45]}}
lights: {{kind: all}}
exposure: {{kind: fixed, exposure_us: 8000}}
darks_per_view: 2
trigger: hardware
reshoot_limit: 3
""",
    "darks": """\
schema_version: 1
name: {name}
rig: {rig}
calibrations: none
views:
  - {{kind: look_at, name: dark, target_mm: [0, 0, 30], distance_mm: 335, azimuth_deg: -90, elevation_deg: 80}}
lights: {{kind: none}}
exposure: {{kind: bracket, exposures_us: [2000, 8000, 32000, 128000]}}
darks_per_view: 20
""",
    "charuco": f"""\
# A ChArUco board on the support, for `coupole calibrate camera` and `hand-eye` (docs/how-to/calibrate.md).
schema_version: 1
name: {{name}}
rig: {{rig}}
calibrations: none
views:
{_board_views()}
lights: {{{{kind: panels, panels: [1]}}}}
exposure: {{{{kind: fixed, exposure_us: 8000}}}}
darks_per_view: 0
""",
    "response": """\
# A scene of different brightness that stands still, under a panel; for `coupole calibrate response`.
schema_version: 1
name: {name}
rig: {rig}
calibrations: none
views:
  - {{kind: look_at, name: still, target_mm: [0, 0, 10], distance_mm: 335, azimuth_deg: -90, elevation_deg: 80}}
lights: {{kind: panels, panels: [1]}}
repeats: 2
exposure: {{kind: bracket, exposures_us: [500, 1000, 2000, 4000, 8000, 12000, 16000, 24000, 32000, 64000, 128000]}}
darks_per_view: 8
""",
    "flat-field": """\
# Panel 1 filling the field, shifted and turned; for `coupole calibrate flat-field --panel-mm 335`.
# `target_mm` is the panel's middle, about which the views are shifted: set it to where yours stands.
schema_version: 1
name: {name}
rig: {rig}
calibrations: none
views:
  - {{kind: look_at, name: f1, target_mm: [0, 650, 450], distance_mm: 335, azimuth_deg: -90, elevation_deg: 0}}
  - {{kind: look_at, name: f2, target_mm: [60, 650, 450], distance_mm: 335, azimuth_deg: -90, elevation_deg: 0,
     roll_deg: 60}}
  - {{kind: look_at, name: f3, target_mm: [-60, 650, 450], distance_mm: 335, azimuth_deg: -90, elevation_deg: 0,
     roll_deg: -60}}
  - {{kind: look_at, name: f4, target_mm: [0, 650, 510], distance_mm: 335, azimuth_deg: -90, elevation_deg: 0,
     roll_deg: 90}}
  - {{kind: look_at, name: f5, target_mm: [0, 650, 390], distance_mm: 335, azimuth_deg: -90, elevation_deg: 0,
     roll_deg: -90}}
  - {{kind: look_at, name: f6, target_mm: [60, 650, 510], distance_mm: 335, azimuth_deg: -90, elevation_deg: 0,
     roll_deg: 30}}
  - {{kind: look_at, name: f7, target_mm: [-60, 650, 390], distance_mm: 335, azimuth_deg: -90, elevation_deg: 0,
     roll_deg: -30}}
lights: {{kind: panels, panels: [1]}}
repeats: 3
exposure: {{kind: bracket, exposures_us: [20, 80, 800, 6400]}}
darks_per_view: 8
""",
    "mesh": """\
# An object with the scanner's stickers, seen from all around at two heights; for `coupole calibrate mesh`.
# `target_mm` is its middle: set it to where yours stands, and name its mesh once it is known where that lies.
schema_version: 1
name: {name}
rig: {rig}
calibrations: none
views:
  - {{kind: grid, name: low, target_mm: [0, 0, 15], distance_mm: 335,
     azimuths_deg: [-180, -135, -90, -45, 0, 45, 90, 135], elevations_deg: [48]}}
  - {{kind: grid, name: high, target_mm: [0, 0, 15], distance_mm: 335,
     azimuths_deg: [-157.5, -112.5, -67.5, -22.5, 22.5, 67.5, 112.5, 157.5], elevations_deg: [70]}}
lights: {{kind: panels, panels: [1, 2, 3, 4]}}
exposure: {{kind: fixed, exposure_us: 8000}}
darks_per_view: 2
""",
    "spectralon": """\
# A white tile at the support's centre, for `coupole calibrate led-power`. Each LED is taken from two sides: where
# the arm shades the tile in one, it does not in the other. Two elevations tell how the tile departs from Lambert's
# law. Their order, and the first view once more at the end, tell drifts of light and gain from this.
schema_version: 1
name: {name}
rig: {rig}
calibrations: none
views:
  - {{kind: look_at, name: even-low, target_mm: [0, 0, 10], distance_mm: 335, azimuth_deg: 45, elevation_deg: 45,
     lights: {{kind: every, every: 2}}}}
  - {{kind: look_at, name: even-high, target_mm: [0, 0, 10], distance_mm: 335, azimuth_deg: -45, elevation_deg: 60,
     lights: {{kind: every, every: 2}}}}
  - {{kind: look_at, name: odd-high, target_mm: [0, 0, 10], distance_mm: 335, azimuth_deg: 45, elevation_deg: 60,
     lights: {{kind: every, every: 2, offset: 1}}}}
  - {{kind: look_at, name: odd-low, target_mm: [0, 0, 10], distance_mm: 335, azimuth_deg: -45, elevation_deg: 45,
     lights: {{kind: every, every: 2, offset: 1}}}}
  - {{kind: look_at, name: again, target_mm: [0, 0, 10], distance_mm: 335, azimuth_deg: 45, elevation_deg: 45,
     lights: {{kind: every, every: 10}}}}
lights: {{kind: all}}
hidden_lights: skip
exposure: {{kind: bracket, exposures_us: [2000, 6000]}}
darks_per_view: 8
""",
    "glare": """\
# A white card with black traps, for `coupole calibrate glare` (docs/how-to/calibrate-glare.md). It fills the first
# four views; in the others something dark fills nearly half of the picture, so that glare from afar shows.
schema_version: 1
name: {name}
rig: {rig}
calibrations: none
views:
  - {{kind: look_at, name: full1, target_mm: [0, 0, 2], distance_mm: 335, azimuth_deg: -90, elevation_deg: 85}}
  - {{kind: look_at, name: full2, target_mm: [18, 12, 2], distance_mm: 335, azimuth_deg: -90, elevation_deg: 85}}
  - {{kind: look_at, name: full3, target_mm: [-18, 6, 2], distance_mm: 335, azimuth_deg: -90, elevation_deg: 85}}
  - {{kind: look_at, name: full4, target_mm: [6, -12, 2], distance_mm: 335, azimuth_deg: -90, elevation_deg: 85}}
  - {{kind: look_at, name: right, target_mm: [100, 0, 2], distance_mm: 335, azimuth_deg: -90, elevation_deg: 85}}
  - {{kind: look_at, name: left, target_mm: [-100, 0, 2], distance_mm: 335, azimuth_deg: -90, elevation_deg: 85}}
  - {{kind: look_at, name: upper, target_mm: [0, 78, 2], distance_mm: 335, azimuth_deg: -90, elevation_deg: 85}}
  - {{kind: look_at, name: lower, target_mm: [0, -78, 2], distance_mm: 335, azimuth_deg: -90, elevation_deg: 85}}
lights: {{kind: panels, panels: [1]}}
repeats: 4
exposure: {{kind: bracket, exposures_us: [4000, 8000]}}
darks_per_view: 8
""",
}
