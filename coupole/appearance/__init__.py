"""Published spectral models of materials and light, and a spectral path tracer. All are functions of arrays that
need no rig."""
