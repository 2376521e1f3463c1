"""Places and normals of the LEDs.

::

    plan.py         which views see all of them, and which lights each view needs
    spots.py        a lit LED in a frame; sources.py, views.py: in all frames of a run
    matching.py     which spot is which LED: dead, swapped and mis-wired ones
    boards.py       LEDs on rigid boards; equations.py, adjustment.py: all in one adjustment with the robot's noise
    workflow.py     runs to record and table; limits.py, drawing.py: what is accepted and shown
"""
