"""Quantities derived from models: what there is, and how it follows from sums over spectra."""

from dataclasses import dataclass

import astropy.units as u
import numpy as np

from miricigale.sed.chain import COLOR_BANDS, COLORS, UV_WINDOWS
from miricigale.utils.arrays import quiet_division
from miricigale.utils.named_values import subset
from miricigale.utils.package_tables import declared


@dataclass(frozen=True)
class Derived:
    """
    One derived quantity: unit, description, whether it scales with mass, and of what.

    Examples
    --------
    >>> from miricigale.sed import DERIVED
    >>> DERIVED["sfr_100myr"].unit, DERIVED["l_6um"].text
    (Unit("solMass / yr"), 'nu L_nu of the AGN at 6 um, as seen')
    """

    unit: u.UnitBase
    text: str
    extensive: bool = True
    of: str = "galaxy"


#: All derived quantities, in the order of the output.
DERIVED = {
    name: Derived(**entry | {"unit": u.Unit(entry["unit"])})
    for name, entry in declared("miricigale.sed", "derived.toml")["quantities"].items()
}


def model_columns(agn, xray):
    """
    Return the derived quantities that come with every evaluation of a model: `Derived` by name.

    ``agn`` says whether it has an AGN, ``xray`` is its component of that role, or None.
    """
    columns = {name: entry for name, entry in DERIVED.items() if agn or entry.of != "agn"}
    if xray is not None:
        for name, (unit, text) in xray.columns.items():
            # the relation is not linear: it is worked out after scaling
            columns[name] = Derived(unit, text, False, "xray")
    return columns


_LOG_UV = np.log10(np.mean(UV_WINDOWS, axis=1))
_BAND = {name: i for i, name in enumerate(COLOR_BANDS)}


def galaxy_quantities(stars, rows, absorbed, sums, reference_row):
    """
    Return the derived quantities of n galaxies for one solar mass formed, in the units of `DERIVED`.

    ``stars`` are `~miricigale.sed.chain.Stars`, of which each galaxy has one of ``rows``, shape (n,);
    ``absorbed``, shape (n,), is the power in W that dust took, ``sums``, shape (n, n_functional), their light
    times ``Chain.functionals``; ``reference`` is the light that AGN fractions refer to, and not in `DERIVED`.
    """
    n = len(_LOG_UV)
    visual = sums[:, 1]
    windows = sums[:, 2 : 2 + n]
    bands = sums[:, 2 + n :]
    with quiet_division():
        logs = np.log10(windows)
        magnitude = -2.5 * np.log10(bands)
        a_v = 2.5 * np.log10(stars.visual[rows] / visual)
    step = _LOG_UV - _LOG_UV.mean()
    out = {}
    for name in ("stellar_mass", "sfr", "sfr_10myr", "sfr_100myr", "age_mass", "age_light"):
        out[name] = getattr(stars, name)[rows]
    out |= {
        "stellar_mass_formed": np.ones(len(rows)),
        "dust_luminosity": absorbed,
        "ir_luminosity": sums[:, 0],
        "reference": sums[:, reference_row],
        "a_v": a_v,
        "beta": logs @ step / (step @ step),
    }
    for name, (blue, red) in COLORS.items():
        out[name] = magnitude[:, _BAND[blue]] - magnitude[:, _BAND[red]]
    return out


def agn_quantities(definition, ratio, galaxy, observed):
    """
    Return the derived quantities of AGN, and ``ir_luminosity`` of galaxies with them: arrays of shape (n,).

    ``definition`` says what the fraction f refers to, ``ratio`` is f / (1 - f), ``galaxy`` comes from
    `galaxy_quantities`; ``observed`` holds, for one watt of torus and polar emission, ``infrared``,
    ``reference``, ``luminosity``, ``six`` and ``accretion``.
    """
    dust = galaxy["dust_luminosity"]
    infrared = galaxy["ir_luminosity"]
    power = ratio * (dust if definition == "dust" else galaxy["reference"] / observed["reference"])
    agn_infrared = power * observed["infrared"]
    total = infrared + agn_infrared
    return {
        "ir_luminosity": total,
        "agn_power": power,
        "agn_luminosity": power * observed["luminosity"],
        "accretion_power": power * observed["accretion"],
        "l_6um": power * observed["six"],
        "frac_agn_dust": _fraction(power, power + dust),
        "frac_agn_ir": _fraction(agn_infrared, total),
    }


def _fraction(part, total):
    return np.divide(part, total, out=np.zeros_like(part), where=part > 0.0)


def scaled_quantities(model, values, mass, redshift, far, parameters):
    """
    Return the derived quantities of galaxies of given masses (Msun formed), from those for one solar mass.

    ``far`` is the luminosity distance in m, ``parameters`` holds values of all parameters.
    """
    out = {}
    for name, entry in model.derived_columns().items():
        if entry.of != "xray":
            if entry.extensive:
                out[name] = values[name] * mass
            else:
                out[name] = values[name]
    xray = model.component("xray")
    if xray is not None:
        xray_values = subset(parameters, xray.parameters)
        out |= xray.derived(out["l_6um"], redshift, far, xray_values)
    return out
