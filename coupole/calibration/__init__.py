"""Calibrations: observations in, result with uncertainty out, one package for each thing that is calibrated.

::

    lens/           camera, its place on the robot, its colours, from images of a board
    leds/           where the LEDs are and face, from views of the LEDs themselves
    stickers/       where a scanned object lies, from its stickers
    light/          sensor, lens and LEDs as radiometers, and their drift
    budget/         what a reflectance is uncertain by, from the records of all

    sources.py      runs and folders of pictures; picture.py: an image, one colour at a time
    poses.py        robot poses as files give them, and what their numbers may mean
    posed_camera.py calibrated_arm.py  what camera and hand-eye records say to the calibrations after them
    optics.py       projection with Brown-Conrady distortion, and its derivatives
    adjustment.py   least squares with variance components: values, covariance, and what dominates it
    multi_view.py point_sets.py rotations.py arm_errors.py  the geometry of it

    request.py         what the operator asks of a calibration; limits.py: what is accepted
    record.py       the result on disk, sealed by its checksum
    report.py       the result as a page and a picture
    in_force.py     which records a plan may be acquired with
"""
