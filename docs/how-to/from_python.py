"""The examples of docs/how-to/from-python.md, in a folder where `coupole demo --short` has been run."""

from pathlib import Path

import numpy as np

import coupole

# ---- read frames ----
(folder,) = Path("coupole-demo/runs").iterdir()
with coupole.open_run(folder) as run:
    top = run["top"]
    dark = np.mean([top[label] for label in top.darks], axis=0)
    frame = top["led0420/e0"]
    signal = frame.pixels - dark
    print(frame.exposure_us, "us,", frame.led_position_mm, "mm,", signal.mean().round(1), "DN")

# ---- a whole view as a dataset ----
dataset = coupole.open_run(folder).dataset("top")
brightest = dataset.pixels.max(dim=("y", "x")).compute().idxmax("shot")
print(brightest.item(), "is the brightest frame; LEDs are in", dataset.led_position_mm.attrs["units"])

# ---- read a result ----
result = coupole.open_result("coupole-demo/reflectance")
assert isinstance(result, coupole.Result)  # of runs, not of pictures
materials = result.materials()
print(result.vertices_mm.shape, result.faces.shape, np.nanmedian(materials.kd, axis=0), "1/sr")
u_tilt_deg = np.degrees(np.sqrt(result.covariances()[:, 0, 0]))
print("normals are known to", np.nanmedian(u_tilt_deg).round(2), "degrees")

# ---- new light ----
lamp = coupole.lights.PointLight(at_mm=(100.0, -200.0, 300.0))
picture = result.relight([lamp], direction=(0.3, 0.2, 1.0), view="top", fit="ggx_normal")
u_picture = result.relight_uncertainty([lamp], direction=(0.3, 0.2, 1.0), view="top", fit="ggx_normal")
print(picture.shape, picture.max(), u_picture.max())
result.to("ply", "coupole-demo-export")

# ---- fit, calibrate, identify, register, compare ----
result = coupole.fit_reflectance(folder, "coupole-demo/reflectance")
print(result.fits, "in", result.folder.name)

# ---- build and check a plan ----
plan = coupole.Plan.read("demo-short")
few_lights = {"kind": "every", "every": 180}
mine = coupole.Plan.model_validate(plan.model_dump() | {"name": "mine", "lights": few_lights})
report = mine.check()
print(report.refusals, report.shots, "shots,", report.duration_s, "s,", report.dose_lux_h, "lux h")
mine.write("mine.yaml")

# ---- acquire ----
with coupole.acquire(mine, output="runs") as events:
    for event in events:
        if isinstance(event, coupole.events.FrameProven):
            print(event.shot, "is proven")
print(events.run, events.figures["proven"], "of", events.figures["shots"])

# ---- use devices ----
with coupole.open_cell("sim") as cell:
    print(cell.identities["ledbox"].model, cell.robot.measured().joints_deg)
    cell.ledbox.panel(1, True)
