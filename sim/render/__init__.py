"""Renderer: computes the radiance of every visible triangle from scene, camera pose and lights.

`lens` gives the ray of a pixel, `raster` the triangle that it sees, `shadows` the LEDs that reach that triangle,
`emitter` the irradiance, `radiance` the light reflected to the camera. None of this code is shared with the
processing of real frames, so that each checks the other.
"""
