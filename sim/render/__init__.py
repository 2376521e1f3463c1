"""The simulated camera's optics: what a pose sees, which lights reach it, and what it sends back.

In order: `lens` (where a pixel looks), `raster` (which triangle it sees), `view` (those triangles, ready for
shading), `leds` (the square emitters), `embree` and `shadows` (which light reaches which triangle), `radiance`
(irradiance and reflection). Nothing here is shared with processing: the two check each other.
"""
