"""
Spectral energy distributions: what galaxies and AGN send out, as components in a chain.

`SEDModel` holds the chain, `SED` is a spectrum, `ModelGrid` the factorised flux tables
that the grid fitter uses; the links of the chain stand in `miricigale.sed.components`.
"""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "components": (),
        "component": ("ROLES", "Component"),
        "derived": ("DERIVED", "Derived"),
        "foreground": (
            "Foreground",
            "GalacticExtinction",
            "band_extinction",
            "color_excess",
            "deredden",
        ),
        "grid": ("ModelGrid",),
        "model": ("SEDModel",),
        "parameter": ("Parameter",),
        # with all components, which make themselves known
        "presets": ("COMPONENTS", "quasar_axes", "survey_axes", "survey_priors", "yang2021_axes"),
        "spectrum": ("COSMOLOGY", "SED", "ModelSpectra"),
        "tables": ("ModelFlags",),
        "templates": ("read_spectra", "template_grid"),
        "xray_bands": ("with_xray_bands",),
        "xray": ("XRay", "band_luminosity", "stern2015", "stern2015_6um", "xray_flux"),
    },
)
