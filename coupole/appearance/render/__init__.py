"""Spectral pictures of scenes by path tracing (`coupole render`): 81 bands, polarisation, caustics.

====================================  =================================================================
`scene_file`, `objects`, `lights`,    the scene file, part by part (pydantic)
`materials`, `spectra`, `model`
`bands`, `description`, `variant`     the scene as Mitsuba's description, four bands at a time
`equivalent`                          films as an equivalent bulk index
`rendering`                           passes, Stokes vectors
`colour`, `pictures`                  observer, adaptation, sRGB; EXR and PNG
`studio`                              one scene from checked data to files
`arcature`, `caustic`, `wall`         a gilded niche, and the sun's light in it by photons
====================================  =================================================================

Mitsuba and colour-science are imported when they are used: they are optional (`coupole[mitsuba,materials]`).
"""
