"""Pose of a scanned object in the base frame, from the scanner's retro-reflective targets.

::

    detection.py    ellipses in a frame; sources.py: in all frames, and the scan's table
    points.py       which of its two possible disks each ellipse is
    mesh_to_robot.py  assignment of targets to stickers, and the mesh's pose
    workflow.py     from runs to record; acceptance.py, drawing.py: acceptance limits and picture
"""
