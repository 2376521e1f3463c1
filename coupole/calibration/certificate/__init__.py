"""A certificate of a whole cell, with the contents that ISO/IEC 17025:2017 lists in 7.8.2 and 7.8.4.

::

    statements.py   what a laboratory states itself: names, place, item, climate, who authorises (YAML)
    chain.py        records, those that they were made from, artefacts: the chain to certificates
    page.py         the printable page, and the same as JSON
"""
