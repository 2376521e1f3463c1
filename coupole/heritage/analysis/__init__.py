"""Analysis of materials from measured spectra."""
