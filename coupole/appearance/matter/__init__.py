"""Spectral appearance of heritage materials: metals, films, paints, gilts, lacquer.

The modules have plain functions on arrays, by the papers named in each file. Spectra are [..., 81] on the grid of
`grid`, 380 to 780 nm by 5 nm; thicknesses carry their unit; complex indices are n + i k.

====================================  =================================================================
`fresnel`, `thin_film`, `indices`     one interface, many, and what they are made of
`kubelka_munk`, `four_flux`           scattering layers under diffuse and under directional light
`pigments`, `typical`                 one pigment's K and S; typical paints for virtual objects
`effective_medium`, `gilding`         gold leaf with holes on bole
`brdf`, `layered`, `tabulated`        reflectance by direction; `hemisphere` adds it up
`makie`, `nashiji`, `lacquer`         urushi
`light`, `channels`                   illuminants, observers, camera channels
`measured`, `resampling`,             spectra from instruments, on the grid, and compared
`identification`
====================================  =================================================================
"""
