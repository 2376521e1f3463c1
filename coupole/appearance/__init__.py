"""Published spectral models of materials and light, and a spectral path tracer. Functions of arrays, without a
rig."""
