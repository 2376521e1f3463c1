"""A scanned object in the robot's base, by the scanner's retro-reflective targets.

::

    detection.py    ellipses in a frame; sources.py: in all frames, and the scan's table
    points.py       their centres in space
    mesh_to_robot.py  which target is which sticker, and where that puts the mesh
    workflow.py     runs to record; limits.py, drawing.py: what is accepted and shown
"""
