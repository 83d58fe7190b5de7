"""Spectra as objects of synphot and specutils."""

import astropy.units as u

from miricigale.utils.optional_packages import require


def synphot_spectrum(sed):
    """Return a spectrum as a `synphot.SourceSpectrum`, as observed."""
    from synphot import SourceSpectrum
    from synphot.models import Empirical1D

    return SourceSpectrum(
        Empirical1D, points=sed.wave.to(u.AA), lookup_table=sed.fnu, meta=sed.meta
    )


def specutils_spectrum(sed):
    """Return a spectrum as one of specutils: ``Spectrum``, or ``Spectrum1D`` before its version 2."""
    specutils = require("specutils", extra="specutils")
    kind = getattr(specutils, "Spectrum", None) or specutils.Spectrum1D
    return kind(spectral_axis=sed.wave, flux=sed.fnu, meta=dict(sed.meta))
