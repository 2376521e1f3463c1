"""One file per calibration, each: observations in, result with uncertainty out.

::

    board.py        a ChArUco or chess board, and its corners in an image
    picture.py      an image, one colour at a time; corner_fit.py: corners in it to thousandths of a pixel
    sources.py      runs and folders of pictures, as images to look for a board in
    poses.py        robot poses as files give them, and what their numbers may mean
    optics.py       projection with Brown-Conrady distortion, and its derivatives
    adjustment.py   least squares with variance components: values, covariance, and what dominates it
    camera.py       intrinsics and distortion from images of a board
    chromatic*.py   a lens for each colour channel: lateral chromatic aberration
    hand_eye.py     A X = X B in closed form: Park, Tsai, Daniilidis
    bundle.py       camera, hand-eye, board and errors of the robot in one adjustment
    calibrated_arm.py  poses as that adjustment's axis zeros correct them
    led_*.py        LEDs: spots in frames, boards as rigid bodies, wiring, one adjustment, the plan of views
    sticker_*.py    the scanner's targets: ellipses in frames, points in space, record
    mesh_to_robot.py  which target is which sticker, and where that puts the mesh
    dark.py response.py flat_field.py led_power.py drift*.py  sensor, lens and LEDs as radiometers
    light_*.py      frames and records of these; spectralon.py, irradiance.py: what a white tile gives back
    measurement.py propagation.py budget*.py  the measurement equation and its uncertainty (JCGM 100 and 101)
    diagnosis.py    why robot and camera contradict each other; hypotheses.py: what may have gone wrong
    limits.py *_limits.py  what is accepted, and the operator's own limits
    workflow.py     images to record and report
    record.py       the result on disk, sealed by its checksum
    in_force.py     which records a plan may be acquired with
    report.py       the result as a page and a picture
"""
