"""`README.txt` of a run, for a person who finds the folder in ten years and does not have Coupole."""

from __future__ import annotations

from typing import Any

_TEXT = """\
{name}
{line}

Photographs of one object, taken by a robot's camera from known places under one known light at a time, in the
dome "La Coupole". What shows that each picture is of the view, light and exposure that it is named after:
{proof}.

object      {object}
begun       {created} (UTC), by {operator}
simulated   {simulated}
software    {software} {version}
licence     {licence}
contact     {contact}

What is here
------------
views/NAME.h5      the pictures of one view: HDF5 (NeXus), readable by any HDF5 program
journal.jsonl      what happened, one JSON object a line; a line "frame" for each picture that is proven
run.json           the request: plan, rig and devices, with the SHA-256 of every file that was used
inputs/            copies of these files: plan, rig, LED table, object's mesh, calibrations, arm
report.html        a summary with pictures, for a browser
manifest.sha256    checksums: `sha256sum -c manifest.sha256` checks every file that it lists

How to read a picture (Python with h5py; `pip install h5py hdf5plugin`)
-----------------------------------------------------------------------
import h5py, hdf5plugin
with h5py.File("views/{view}.h5") as file:
    detector = file["entry/instrument/detector"]
    slots = [(row["shot"].decode(), slot) for slot, row in enumerate(detector["frames"]) if row["state"] == 2]
    print(slots[0], detector["data"][slots[0][1]])

A picture is named <view>/<light>/e<exposure>: `{view}/led0417/e0` is view {view}, LED 417, first exposure.
Only rows of `frames` with state 2 are proven pictures. Pixel values are raw: DN, with the pattern of the colour
filter in `bayer_pattern`, the black level in `black_level`, saturation in `saturation_value`.
If `data` has the type uint8, three bytes hold two pixels; its attribute `packing` says how.
{discarded}
Units and frames of reference
-----------------------------
Lengths are in mm, angles in degrees, exposures in us. Transforms `a_from_b` are 4x4 and map coordinates of b to
coordinates of a: p_a = a_from_b @ (x, y, z, 1).
base       the robot's base; poses, LED positions and normals are in it
support    the disk that carries the object: origin at its centre, z up
object     the mesh's own frame; `support_from_object` is in inputs/plan.yaml
flange     the robot's last flange
camera     origin at the projection centre, x right and y down in the picture, z forward
The pose of each picture is the row `pose` of `entry/instrument/robot/poses`. LEDs are in `entry/instrument/leds`,
the lens in `entry/instrument/lens`.
"""
_DISCARDED = """\
As the plan says, pictures may have been discarded after samples of reflectance were taken from them and were
safe. Their rows in `frames` have state 3 and their pixels read as 0; lines "discard" of journal.jsonl name them,
with the folder of the samples, which is not this one.
"""


def readme(folder_name: str, about: dict[str, Any]) -> str:
    """Return the text, from the content of run.json."""
    views = ["NAME"] if "most_views" in about else about.get("views") or ["NAME"]
    return _TEXT.format(
        name=folder_name,
        line="=" * len(folder_name),
        object=about.get("object") or "none named",
        created=about["created"],
        operator=about["operator"],
        simulated="yes: no real light, no real object" if about.get("simulated") else "no",
        software=about["software"]["name"],
        version=about["software"]["version"],
        proof=about.get("proof", "not recorded"),
        licence=about.get("licence") or "not stated",
        contact=about.get("contact") or "not stated",
        view=views[0],
        discarded=_DISCARDED if about.get("discard") else "",
    )
