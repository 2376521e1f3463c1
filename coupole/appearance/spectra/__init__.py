"""The wavelength grid, light sources, measured spectra and camera channels."""
