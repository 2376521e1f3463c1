"""Plans to start from: `coupole plan new NAME`."""

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
calibrations: none
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
views:
  - {{kind: look_at, name: dark, target_mm: [0, 0, 30], distance_mm: 335, azimuth_deg: -90, elevation_deg: 80}}
lights: {{kind: none}}
exposure: {{kind: bracket, exposures_us: [2000, 8000, 32000, 128000]}}
darks_per_view: 20
""",
}
