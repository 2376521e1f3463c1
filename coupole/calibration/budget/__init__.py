"""What a reflectance is uncertain by (JCGM 100 and 101).

::

    measurement.py  the measurement equation
    propagation.py  Monte Carlo and the linear formula, and whether that would do
    records.py      what records say of each input; accuracy.py: beside the paper's figures
    budget.py       shares of the sources; report.py, page.py: as table, picture and page
"""
