"""The wavelength grid, light sources, measured spectra and what a camera makes of them."""
