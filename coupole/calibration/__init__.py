"""Calibrations: from observations to a result with its uncertainty. There is one package for each thing that is
calibrated.

::

    lens/           camera, its place on the robot, and its colours, from images of a board
    leds/           positions and normals of the LEDs, from views of the LEDs themselves
    stickers/       pose of a scanned object, by its stickers
    light/          radiometry of sensor, lens and LEDs, and its drift
    colour/         colour profile from a chart, and figures of image quality
    check/          the calibrated cell measures a board or tile that no fit has used
    certificate/    a certificate of the whole cell
    budget/         uncertainty of a reflectance, from the records of all calibrations

    sources.py      runs and folders of pictures; grey_image.py: an image, one colour at a time
    poses.py        robot poses from files, and their possible conventions
    posed_camera.py calibrated_arm.py  camera and hand-eye records as observations of later calibrations
    optics.py       projection with Brown-Conrady distortion, and its derivatives
    adjustment.py   least squares with variance components: values, covariance and its dominant sources
    multi_view.py point_sets.py rotations.py arm_errors.py  geometry that several packages use

    request.py      the operator's request; acceptance.py: acceptance limits
    artefact.py     certificates of boards, tiles, charts; traceability.py: sentences about them
    validity.py     records that have expired by drift
    record.py       the result on disk, sealed by its checksum
    report.py       the result as a page and a picture
    in_force.py     whether a plan may be acquired with the records that it names
"""
