"""Camera and hand-eye.

::

    board.py        a ChArUco or chess board, and its corners in an image; images.py: in all images
    corner_fit.py   corners to thousandths of a pixel
    camera.py       intrinsics and distortion, with covariance
    chromatic*.py   a lens for each colour channel: lateral chromatic aberration
    hand_eye.py     A X = X B in closed form: Park, Tsai, Daniilidis
    bundle.py       camera, hand-eye, board and errors of the robot in one adjustment; equations.py: its equations
    diagnosis.py    why robot and camera contradict each other; hypotheses.py: the possible causes
    workflow.py     from images to record; acceptance.py, drawing.py: acceptance limits and picture
"""
