"""Published physics of matter and light, by wavelength, and a spectral path tracer. Takes arrays, reads no rig."""
