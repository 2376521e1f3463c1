"""Virtual objects: small generators of `sim.scene.surface.Surface`, in mm, in the object's own frame, with z up.

Bodies stand on z = 0 above the origin; `plane` and `fabric` are sheets.
The same arguments give the same triangles.

=============  ============================================================================
`shapes`       plane, sphere, glossy sphere, sculpted relief
`board`        ChArUco board, one rectangle for each black or white cell
`targets`      Spectralon tile, grey card, chrome ball, stickers
`wedges`       gilt step wedge, paint wedge over black and white
`urushi`       makie tile, nashiji slab
`fabric`       woven cloth
`appearance`   their materials, per channel of the camera
`mesh`         pieces of surfaces
=============  ============================================================================
"""
