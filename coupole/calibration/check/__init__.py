"""Checks of a calibrated cell with artefacts that were used in no fit: a second board, a second tile.

::

    board_lengths.py    lengths on a board, by rays of the calibrated camera at reported poses
    tile_reflectance.py reflectance of a tile, by the calibrated powers of the LEDs
    workflow.py         records in force, artefacts that are refused, the record of a check
    permissible.py      largest permissible error of a length
    drawing.py          its picture and its part of the page; acceptance.py: its limits
"""
