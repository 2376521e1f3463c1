"""Results of runs for other programs: a module for each format, with `write(surface, folder)`, which gives the
files it has written."""

FORMATS = {
    "ply": "the mesh, with each triangle's material, normal and uncertainties",
    "gltf": "a .glb for viewers and browsers: texture of colour, roughness and specular",
    "materialx": "a MaterialX document of OpenPBR, with textures and mesh",
    "exr": "a multi-part OpenEXR for each view: material, normal, place and uncertainties of each pixel",
    "bsdf": "tables of materials in RGL's tensor format, for Mitsuba",
    "merl": "tables of materials as the MERL database has them",
    "bird": "samples of triangles as JSON of the BiRD project, with standard uncertainties",
    "alta": "tables of materials as text for ALTA, with 95 % bounds",
}
"""What each module gives, by its name, which is the format's."""
OF_MATERIALS = ("bsdf", "merl", "bird", "alta")
"""Formats of single materials, of triangles or clusters."""
