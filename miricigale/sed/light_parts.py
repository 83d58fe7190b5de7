"""
The light of a chain in its parts: stars with their gas, the dust, and the AGN.

A galaxy of one solar mass formed is starlight behind dust, S, and the light of the dust, which is the power L that
the dust took times a template D of one watt. Both S and L follow a straight line in the mass fraction of a burst.
Each part depends on a few parameters only, so that each can be tabulated much more finely than the whole.
"""

import numpy as np

from miricigale.sed.chain import STELLAR, VISUAL, Stars
from miricigale.sed.derived import galaxy_quantities
from miricigale.sed.gridding import BandSums, Starlight, agn_table
from miricigale.utils.arrays import nans
from miricigale.utils.values import value_class

#: Time spans in Gyr over which star-formation rates are averaged, by quantity.
RATE_SPANS = {"sfr_10myr": 0.01, "sfr_100myr": 0.1}
#: Years in a Gyr.
_YEARS = 1e9
#: First columns of `LightParts.starlight`, before the sums over the light.
_STELLAR_COLUMNS = (
    "stellar_mass",
    "sfr",
    "sfr_10myr",
    "sfr_100myr",
    "age_mass",
    "visual",
    "visual_stars",
    "visual_age",
)
#: Columns of masses formed in a time span, in Gyr, by their number.
FORMED_COLUMNS = {_STELLAR_COLUMNS.index(name): span for name, span in RATE_SPANS.items()}


@value_class
class PartTable:
    """
    One part of the light for n sets of parameters.

    Parameters
    ----------
    flux : `~numpy.ndarray`, shape (n, nz, nb)
        Fluxes in uJy, of starlight for one solar mass formed, of dust and AGN for one watt.
    columns : `~numpy.ndarray`, shape (n, n_columns)
        What does not depend on redshift.
    """

    flux: np.ndarray
    columns: np.ndarray


class LightParts:
    """
    Parts of the light of a model.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`
    filters : `~miricigale.filters.FilterSet`
    redshift : `~numpy.ndarray`, shape (nz,)
    constants : dict of str to float
        Values of parameters that are not at their defaults, but the same for all rows.

    Attributes
    ----------
    n_bands : int
        Number of bands.
    """

    def __init__(self, model, filters, redshift, constants=None):
        self.model = model
        self.redshift = np.asarray(redshift, float)
        self.n_bands = len(filters)
        self.values = model.defaults | dict(constants or {})
        self.sums = BandSums(model, self.values, filters, self.redshift)

    def _rows(self, rows):
        return [self.values | dict(row) for row in rows]

    def starlight(self, rows):
        """
        Return the starlight behind dust, for one solar mass formed.

        Parameters
        ----------
        rows : list of dict
            Parameters that differ from the defaults and constants.

        Returns
        -------
        table : `PartTable`
            The columns are masses and rates (masses formed in the spans of `RATE_SPANS`), ages times what weighs
            them, sums over the light with ``Chain.functionals``, and last the power in W that dust takes.
        """
        values = self._rows(rows)
        starlight = Starlight(self.model.chain, values)
        functions = [self.sums, self.model.chain.functional_sums]
        (flux, functionals), absorbed = starlight.sums(functions)
        stars = starlight.stars
        of_row = starlight.star_rows
        columns = {name: getattr(stars, name)[of_row] for name in _STELLAR_COLUMNS[:5]}
        age = np.array([row["age"] for row in values])
        for name, span in RATE_SPANS.items():
            # the mass formed in the span has no kink where galaxies are younger
            columns[name] = columns[name] * np.minimum(age, span) * _YEARS
        columns["visual"] = stars.visual[of_row]
        # ages are weighted with the light of stars without their gas
        without_gas = stars.visual
        if stars.nebular_young is not None:
            at = self.model.chain.at[VISUAL]
            without_gas = without_gas - stars.nebular_young[:, at] - stars.nebular_old[:, at]
        columns["visual_stars"] = without_gas[of_row]
        columns["visual_age"] = (without_gas * stars.age_light)[of_row]
        parts = [np.array([columns[name] for name in _STELLAR_COLUMNS]).T, functionals]
        parts.append(absorbed[:, None])
        return PartTable(flux, np.concatenate(parts, axis=1))

    def absorbed(self, rows):
        """Return the power in W that dust takes from the starlight of one solar mass formed, shape (n,)."""
        _, absorbed = Starlight(self.model.chain, self._rows(rows)).sums([])
        return absorbed

    def dust(self, rows):
        """Dust for one watt; the columns are sums over its light with ``Chain.functionals``: `PartTable`."""
        chain = self.model.chain
        spectra = chain.dusts([chain.key(row, "dust") for row in self._rows(rows)])
        return PartTable(self.sums(spectra), chain.functional_sums(spectra))

    def agn(self, rows):
        """AGN for one watt of what AGN fractions refer to; the columns are its properties: `PartTable`."""
        chain = self.model.chain
        parts = [chain.agn(row) for row in self._rows(rows)]
        spectra, properties = agn_table(self.model, parts)
        columns = [np.asarray(column.value) for column in properties.itercols()]
        # these are L_nu, and the sums take L_lambda
        return PartTable(self.sums(spectra / chain.to_lnu), np.array(columns).T)


def quantities_of_parts(starlight, absorbed, dust, age, reference_row):
    """
    Return the derived quantities of galaxies for one solar mass formed, from columns of their parts.

    Parameters
    ----------
    starlight : `~numpy.ndarray`, shape (n, n_columns)
        Columns of `LightParts.starlight`; the last is not used.
    absorbed : `~numpy.ndarray`, shape (n,)
        Power in W of the dust's light.
    dust : `~numpy.ndarray`, shape (n, n_functional)
        Columns of `LightParts.dust`.
    age : `~numpy.ndarray`, shape (n,)
        Time in Gyr since the first stars.
    reference_row : int
        ``Chain.reference_row``.

    Returns
    -------
    quantities : dict of str to `~numpy.ndarray`
        As `~miricigale.sed.derived.galaxy_quantities` gives them.
    """
    n_stellar = len(_STELLAR_COLUMNS)
    columns = dict(zip(_STELLAR_COLUMNS, starlight[:, :n_stellar].T, strict=True))
    for name, span in RATE_SPANS.items():
        columns[name] = columns[name] / (np.minimum(age, span) * _YEARS)
    visual_age = columns.pop("visual_age")
    visual = columns.pop("visual_stars")
    columns["age_light"] = np.divide(visual_age, visual, out=nans(len(visual)), where=visual > 0)
    # sums over the light take the place of the spectra
    no_spectra = dict.fromkeys(("young", "old", "nebular_young", "nebular_old", "dust_power"))
    stars = Stars(**no_spectra, **columns)
    sums = starlight[:, n_stellar:-1] + absorbed[:, None] * dust
    rows = np.arange(len(starlight))
    return galaxy_quantities(stars, rows, absorbed, sums, reference_row)


def part_parameters(model):
    """
    Return the names of the parameters that shape each part.

    Returns
    -------
    names : dict of str to tuple of str
        ``"starlight"``, ``"dust"`` and ``"agn"``; the AGN's without its fraction.
    """
    names = model.chain.names
    of_agn = tuple(name for name in names("agn") if name != "frac_agn")
    return {
        "starlight": names(STELLAR) + names("attenuation"),
        "dust": names("dust"),
        "agn": of_agn,
    }
