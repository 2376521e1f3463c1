"""From a scene, a camera pose and the lights that shone to the radiance of every visible triangle.

`lens` says where a pixel looks, `raster` which triangle it sees, `shadows` which LEDs reach that triangle,
`emitter` how much light arrives, `radiance` how much of it goes on to the camera. None of this is shared with the
processing of real frames: the two check each other.
"""
