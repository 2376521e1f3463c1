"""From measured spectra to materials."""
