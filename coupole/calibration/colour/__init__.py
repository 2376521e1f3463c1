"""Colour from a chart: the profile of a camera under its lights, and figures of image quality.

::

    chart.py            the chart: patches, place, edges; chart_values.py, cxf_values.py: what was measured of
                        its patches
    colorimetry.py      XYZ of spectra, L*a*b*, CIEDE2000
    chart_views.py      patches and edges in frames of runs; chart_pictures.py: in plain pictures
    chart_signals.py    one signal for each patch from many lights, shaded and saturated ones left out
    colour_profile.py   the matrix and the root-polynomial, with leave-out and uncertainty
    icc_profile.py      the profile for other programs
    slanted_edge.py     spatial frequency response, shift between colours
    image_quality.py    tone, noise, sharpness, uniformity and colour, with published levels
    colour_workflow.py  from frames to the record
"""
