"""How surveys call the columns of their catalogs."""

import dataclasses
import re
import types

from miricigale.filters.band_names import find_filter
from miricigale.filters.filter import Filter
from miricigale.utils.exceptions import DataError
from miricigale.utils.tables import error_column


@dataclasses.dataclass(frozen=True)
class _Survey:
    """
    How a survey calls its columns.

    ``flux`` is a regular expression whose first group is the band, ``error`` the name of its errors by the
    groups, ``unit`` that of both where the file has none, ``names`` the choices for other columns, ``bands``
    filters of names that mean another one elsewhere (None: no curve here).
    """

    flux: str
    error: str
    unit: str
    names: dict
    bands: dict = dataclasses.field(default_factory=dict)

    def columns(self, colnames):
        """Our names of the columns that are there to theirs; the bands without a filter."""
        found, lost = {}, []
        for ours, choices in self.names.items():
            theirs = next((name for name in choices if name in colnames), None)
            if theirs is not None:
                found[ours] = theirs
        for name in colnames:
            match = re.fullmatch(self.flux, name)
            error = match and match.expand(self.error)
            if error not in colnames:
                continue
            band = self.bands.get(match[1], "")
            if band == "":
                band = find_filter(match[1])
            if band is None or not is_band(band):
                lost.append(name)
            elif band in found:
                msg = f"the columns {found[band]} and {name} are both the filter {band}"
                raise DataError(msg)
            else:
                found |= {band: name, error_column(band): error}
        return found, lost


_POSITION = {"id": ("id", "ID", "NUMBER"), "ra": ("ra", "RA"), "dec": ("dec", "DEC")}
_CIGALE = _Survey(r"(.+?)(?<!_err)", r"\1_err", "mJy", {"id": ("id",), "redshift": ("redshift",)})

#: Column names and units of catalogs, by name of the survey.
SURVEYS = types.MappingProxyType(
    {
        # Guo et al. 2013, Galametz et al. 2013, Nayyeri et al. 2017, Stefanon et al. 2017, Barro et al. 2019
        "candels": _Survey(r"(.+)_FLUX", r"\1_FLUXERR", "uJy", _POSITION),
        # Skelton et al. 2014: zero point 25 AB
        "3dhst": _Survey(
            r"f_(.+)", r"e_\1", "0.363078 uJy", _POSITION | {"redshift": ("z_best", "z_peak")}
        ),
        # Rieke et al. 2023: total (Kron) fluxes on images of one PSF, or on their own
        "jades": _Survey(r"(F\d+[WMN]\d?)(_KRON(?:_CONV)?)", r"\1\2_e", "nJy", _POSITION),
        # Valentino et al. 2023: total fluxes from the aperture of 0.5 arcsec
        "dja": _Survey(
            r"(f\d+[wmn]\d?)(-clear)?_tot_1",
            r"\1\2_etot_1",
            "uJy",
            _POSITION | {"redshift": ("z_best", "z_phot")},
        ),
        # Weaver et al. 2022: Farmer, and Classic in apertures of 2 arcsec, which are not corrected to total
        "cosmos2020": _Survey(
            r"(.+)_FLUX(_APER2)?",
            r"\1_FLUXERR\2",
            "uJy",
            _POSITION
            | {
                "ra": ("ALPHA_J2000",),
                "dec": ("DELTA_J2000",),
                "redshift": ("lp_zBEST", "lp_zPDF", "ez_z_phot"),
            },
            # the band u of 2014 and later has another curve than u*
            {"CFHT_ustar": "megacam.u", "CFHT_u": None},
        ),
        # as CIGALE's: names of bands, _err, mJy (those of Lisiecki et al. 2025)
        "ceers": _CIGALE,
        "cigale": _CIGALE,
    }
)


def is_band(name):
    """Whether a column is called by a filter of the library, or is the error of one."""
    band = name.removesuffix(error_column(""))
    return band in Filter.names() or band.startswith("sedpy.")
