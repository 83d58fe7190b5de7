"""Figures of SED components: a panel for each of their main parameters, drawn with a few values."""

import matplotlib.pyplot as plt
import numpy as np

from miricigale.refdata import resource
from miricigale.sed import COMPONENTS

__all__ = ["VARIED", "draw", "panels_of"]

#: Values that a component is drawn with, by parameter; redshift and age (Myr) are the user's. One that is not
#: here has its first parameters at three values each.
VARIED = {
    "delayed": {"tau": (0.1, 0.5, 1, 3), "f_burst": (0, 0.05, 0.2)},
    "double_exponential": {"tau": (-3, 1, 3, 6), "f_burst": (0, 0.05, 0.2)},
    "constant": {"age": (0.3, 1, 3)},
    "bc03": {"age_ssp": (3, 30, 300, 3000), "metallicity": (0.0004, 0.004, 0.02, 0.05)},
    "nebular": {"log_u": (-3.5, -2, -1), "metallicity_gas": (0.0004, 0.004, 0.02)},
    "calzetti": {"ebv": (0.1, 0.3, 0.6), "slope": (-0.6, 0, 0.4), "uv_bump": (0, 1.5, 3)},
    "modified_starburst": {"ebv_lines": (0.3, 0.6, 1), "r_v_gas": (2.5, 3.1, 5)},
    "smc": {"ebv": (0.05, 0.1, 0.3)},
    "charlot_fall": {"av_ism": (0.5, 1, 2), "mu": (0.3, 0.44, 1), "slope_bc": (-1.6, -1.3, -0.7)},
    "dl07": {"q_pah": (0.47, 2.5, 4.58), "u_min": (0.1, 1, 10), "gamma": (0, 0.02, 0.2)},
    "dl07_alpha": {"alpha": (1, 1.5, 2, 3)},
    "casey2012": {
        "temperature_dust": (25, 35, 60),
        "emissivity_dust": (1, 1.6, 2.5),
        "alpha_mir": (1.5, 2, 3),
    },
    "parametric_torus": {
        "inclination": (20, 50, 70, 90),
        "tau97": (3, 7, 11),
        "ebv_polar": (0, 0.1, 0.3),
    },
    "xray": {"photon_index": (1.4, 1.8, 2.2), "xray_transmission": (0.1, 0.5, 1)},
    "meiksin2006": {"redshift": (1, 2, 3, 4, 5)},
    "madau1995": {"redshift": (1, 2, 3, 4, 5)},
    "inoue2014": {"redshift": (1, 2, 3, 4, 5)},
    "galactic_extinction": {"ebv_galactic": (0.01, 0.03, 0.1), "r_v": (2.5, 3.1, 5)},
}
# what is set besides, so that the parameter of the panel makes a difference
_BESIDES = {
    "delayed": {"age": 5.0, "age_burst": 0.3, "tau_burst": 0.1},
    "double_exponential": {"age": 5.0, "age_burst": 0.3, "tau_burst": 0.1},
    "galactic_extinction": {"ebv_galactic": 0.03},
    "parametric_torus": {"inclination": 30.0},
}
_OPTIONS = {"nebular": {"gas": "free"}}
_WAVE = "rest wavelength (µm)"
_TORUS_PANELS = {"tau97": {"inclination": 85.0}}


def _history(part, values):
    rate = part.history(values) * 1e9
    return np.arange(rate.size) / 1e3, rate


def _stars(part, values):
    age, spectra, _ = part.table(values["metallicity"])
    wave = part.nodes()
    return wave, wave * spectra[np.argmin(abs(age - values["age_ssp"]))]


def _gas(part, values):
    ones = np.ones(1)
    light = part.spectra(3.0 * ones, ones, 1e47 * ones, values | {"metallicity": 0.02})
    return part.nodes(), part.nodes() * light


def _attenuation(part, values):
    wave = np.geomspace(0.13, 3, 400)
    gas = part.gas_factor(wave, values)
    return wave, -2.5 * np.log10(part.factors(wave, values)[0] if gas is None else gas)


def _dust(part, values):
    wave = part.nodes()
    return wave, wave * part.template(wave, **values)


def _agn(part, values):
    wave = part.nodes()
    return wave, wave * part.templates(wave, values).total


def _xrays(part, values):
    from miricigale.sed.cosmology import COSMOLOGY, distance

    redshift = np.linspace(0.1, 5, 200)
    flux = part.derived(1e37, redshift, distance(redshift, COSMOLOGY), values)["xray_flux"]
    return redshift, 1e3 * flux  # W/m2 to erg/s/cm2


def _igm(part, values):
    wave = np.linspace(0.15, 0.8, 3000)
    return wave, part.transmission(wave, values["redshift"])


def _foreground(part, values):
    wave = np.geomspace(0.0915, 32, 800)
    return wave, -2.5 * np.log10(part.transmission(wave, values))


def panels_of(name):
    """
    Values that a component is drawn with, by parameter.

    Parameters
    ----------
    name : str
        The component's ``name``.

    Returns
    -------
    panels : dict of str to sequence of float
        Empty for components whose data users bring.
    """
    cls = COMPONENTS.get(name)
    is_brought = cls.resource and resource(cls.resource).kind == "user"
    if is_brought or name == "sfh_table":
        return {}
    if name in VARIED:
        return VARIED[name]
    panels = {}
    for parameter in list(cls.declared().values())[:3]:
        low, high = parameter.bounds
        panels[parameter.name] = np.linspace(low, high, 5)[1:4]
    return panels


_LOGS = {"xscale": "log", "yscale": "log"}
#: By role: curve, labels and limits of the axes.
_CURVES = {
    "sfh": (
        _history,
        {"xlabel": "time since the first stars (Gyr)", "ylabel": "SFR (1/Gyr)"},
    ),
    "stellar": (
        _stars,
        _LOGS | {"xlabel": _WAVE, "ylabel": "$\\lambda L_\\lambda$ (W/M$_\\odot$)"}
        | {"xlim": (0.05, 10), "ylim": (1e24, 1e33)},
    ),
    "nebular": (
        _gas,
        {"yscale": "log", "xlabel": _WAVE, "ylabel": "$\\lambda L_\\lambda$ (W)"}
        | {"xlim": (0.478, 0.506), "ylim": (1e28, None)},
    ),
    "attenuation": (
        _attenuation,
        {"xscale": "log", "xlabel": _WAVE, "ylabel": "attenuation (mag)", "xlim": (0.1, 3)},
    ),
    "dust": (
        _dust,
        _LOGS | {"xlabel": _WAVE, "ylabel": "$\\lambda L_\\lambda$ of 1 W (W)"}
        | {"xlim": (2, 1000), "ylim": (2e-3, 2)},
    ),
    "agn": (
        _agn,
        _LOGS | {"xlabel": _WAVE, "ylabel": "$\\lambda L_\\lambda$ (W)"}
        | {"xlim": (0.1, 300), "ylim": (3e-3, 5)},
    ),
    "xray": (
        _xrays,
        {"yscale": "log", "xlabel": "redshift", "ylabel": "flux (erg s$^{-1}$ cm$^{-2}$)"},
    ),
    "igm": (_igm, {"xlabel": "observed wavelength (µm)", "ylabel": "transmission"}),
    "foreground": (
        _foreground,
        _LOGS | {"xlabel": "observed wavelength (µm)", "ylabel": "extinction (mag)"},
    ),
}  # fmt: skip


def draw(name):
    """
    Draw a component on a new figure: one panel for each parameter of `panels_of`.

    Parameters
    ----------
    name : str
        The component's ``name``.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    cls = COMPONENTS.get(name)
    part = cls(**_OPTIONS.get(name, {}))
    curve, axes = _CURVES[cls.role]
    defaults = {key: par.default for key, par in part.parameters.items()} | {"age_ssp": 1000.0}
    if cls.role == "dust":
        del defaults["age_ssp"]
    panels = panels_of(name)
    figure, row = plt.subplots(
        1, len(panels), figsize=(max(6, 2.8 * len(panels)), 3.2), sharey=True, squeeze=False
    )
    for ax, (key, numbers) in zip(row[0], panels.items(), strict=True):
        besides = _BESIDES.get(name, {}) | (_TORUS_PANELS.get(key, {}) if cls.role == "agn" else {})
        for i, number in enumerate(numbers):
            color = plt.cm.viridis(0.85 * i / max(len(numbers) - 1, 1))
            x, y = curve(part, defaults | besides | {key: float(number)})
            ax.plot(x, y, color=color, lw=1.3, label=f"{number:g}")
        par = part.parameters.get(key)
        unit = "Myr" if key == "age_ssp" else par.unit.to_string() if par else ""
        label = "age of the population" if key == "age_ssp" else key
        ax.legend(title=f"{label} ({unit})" if unit else label, fontsize="small")
        ax.set(**axes)
        ax.xaxis.set_minor_formatter("")
    for ax in row[0, 1:]:
        ax.set_ylabel("")
    return figure
