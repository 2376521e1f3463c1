"""The uncertainty budget of a reflectance (JCGM 100 and 101).

::

    measurement.py  the measurement equation
    propagation.py  Monte Carlo and the linear formula, and the test of the latter
    records.py      uncertainties of the inputs from records; accuracy.py: comparison with the paper
    budget.py       contributions of the sources; report.py, page.py: table, picture and page
"""
