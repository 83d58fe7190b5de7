"""What the modules of CIGALE are here: components, their options, axes of a grid."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.fitting.cigale.catalog import read_table
from miricigale.fitting.cigale.chain import Chain, Module
from miricigale.sed import components as c
from miricigale.utils.exceptions import ConfigError

__all__ = ["read_modules"]

_IMF = {0: "Salpeter", 1: "Chabrier"}
_MYR, _NM = 1e-3, 1e-3  # to Gyr, to um


def _sfhdelayed(m):
    _burst(m, c.DelayedSFH, age="age_main", age_burst="age_burst")


def _sfh2exp(m):
    _burst(m, c.DoubleExponentialSFH, age="age", age_burst="burst_age")


def _burst(m, kind, *, age, age_burst):
    m.add(
        kind,
        m.values(
            tau=("tau_main", _MYR),
            age=(age, _MYR),
            f_burst="f_burst",
            age_burst=(age_burst, _MYR),
            tau_burst=("tau_burst", _MYR),
        ),
    )


def _sfhfromfile(m):
    path = m.folder / m.text("filename")
    table = read_table(path, "a star-formation history")
    rates = QTable()
    for i, name in enumerate(table.colnames):
        unit = table[name].unit or (u.Myr if i == 0 else u.Msun / u.yr)
        rates["time" if i == 0 else name] = np.asarray(table[name], dtype=float) * u.Unit(unit)
    columns = m.numbers("sfr_column", 1)
    m.chain.differs.append("sfhfromfile: one step of 1 Myr less at the same age")
    values = {"sfh_index": ("sfr_column", columns - 1.0)} | m.values(age=("age", _MYR))
    m.add(c.TableSFH, values, table=rates)


def _bc03(m):
    imf = _IMF.get(int(m.one("imf", 0)), "another")
    metallicity = m.numbers("metallicity", 0.02)
    values = {"metallicity": ("metallicity", metallicity)}
    values["separation_age"] = ("separation_age", np.array([m.one("separation_age", 10.0)]))

    def covers(library):
        if imf.lower() not in library.imf.lower():
            return f"the files have a {library.imf} IMF, not {imf}"
        return next(filter(None, (library.invalid({"metallicity": z}) for z in metallicity)), None)

    kind, _ = m.choose(c.BC03Library, c.BC03, covers)
    if kind is c.BC03:
        m.chain.differs.append(f"{imf} IMF: {kind.imf} (bundled BC03)")
    m.add(kind, values)


def _nebular(m):
    if m.text("emission", "True").lower() in ("false", "0", "no"):
        for key in ("logU", "zgas", "ne", "f_esc", "f_dust", "lines_width"):
            m.text(key)
        m.chain.differs.append("nebular.emission = False: no gas at all")
        return
    values = m.values(log_u="logU", f_esc="f_esc", f_dust="f_dust")
    zgas, stellar = m.numbers("zgas"), _metallicity(m.chain)
    if m.numbers("ne", 100.0).tolist() != [100.0]:
        m.chain.left_out.append("nebular.ne")
    options = {"line_width": m.one("lines_width", 300.0), "gas": "stellar"}
    if zgas is not None and not np.array_equal(zgas, stellar):
        known = np.array(c.Nebular().table.metallicities)
        nearest = known[np.argmin(np.abs(np.log(zgas[:, None] / known)), axis=1)]
        for have, got in zip(zgas, nearest, strict=True):
            if abs(got / have - 1.0) > 1e-3:
                m.chain.replaced.append(f"nebular.zgas = {have:g} by {got:g}")
        values["metallicity_gas"] = ("zgas", np.unique(nearest))
        options["gas"] = "free"
    m.chain.differs.append("nebular: Cloudy tables of another make")
    m.add(c.Nebular, values, **options)


def _metallicity(chain):
    """Metallicities of the stars."""
    stars = next((x for x in chain.components if x.role == "stellar"), None)
    if stars is None:
        return np.zeros(0)
    return chain.axes.get("metallicity", np.array([stars.metallicity]))


def _calzleit(m):
    values = m.values(ebv="E_BVs_young", ebv_factor="E_BVs_old_factor")
    m.add(c.CalzettiLeitherer, values | _curve(m), ebv_scaling="cigale")


def _curve(m):
    return m.values(
        slope="powerlaw_slope",
        uv_bump="uv_bump_amplitude",
        uv_bump_wavelength=("uv_bump_wavelength", _NM),
        uv_bump_width=("uv_bump_width", _NM),
    )


def _modified_starburst(m):
    law = m.option("Ext_law_emission_lines", 1, {1: "mw", 2: "lmc", 3: "smc"})
    values = m.values(ebv_lines="E_BV_lines", ebv_factor_stars="E_BV_factor", r_v_gas="Rv")
    m.add(c.ModifiedStarburst, values | _curve(m), gas_law=law, ebv_scaling="cigale")


def _modified_cf00(m):
    values = m.values(av_ism="Av_ISM", mu="mu", slope_ism="slope_ISM", slope_bc="slope_BC")
    m.add(c.CharlotFall, values)


def _dale2014(m):
    if np.any(m.numbers("fracAGN", 0.0) != 0.0):
        m.chain.left_out.append("dale2014.fracAGN")
    kind, why = m.choose(c.Dale2014, c.DraineLi2007Alpha, lambda _: None)
    m.add(kind, m.values(alpha="alpha"), why=why)


def _casey2012(m):
    m.add(
        c.Casey2012,
        m.values(temperature_dust="temperature", emissivity_dust="beta", alpha_mir="alpha"),
    )


def _dl2007(m):
    if m.numbers("umax", 1e6).tolist() != [1e6]:
        m.chain.replaced.append("dl2007.umax by 1e6")
    m.add(c.DraineLi2007, m.values(u_min="umin", q_pah="qpah", gamma="gamma"))


_SKIRTOR = {
    "tau97": "t",
    "p": "pl",
    "q": "q",
    "opening_angle": "oa",
    "radius_ratio": "R",
    "inclination": "i",
    "disk_slope": "delta",
    "frac_agn": "fracAGN",
    "ebv_polar": "EBV",
    "temperature_polar": "temperature",
    "emissivity_polar": "emissivity",
}


def _skirtor2016(m):
    values = m.values(**_SKIRTOR)
    options = {
        "polar_law": m.option("law", 0, {0: "smc", 1: "calzetti", 2: "gaskell"}),
        # files of older versions have no choice
        "disk": m.option("disk_type", 0, {0: "skirtor", 1: "schartmann2005"}),
    }
    if m.numbers("Mcl", 0.97).tolist() != [0.97]:
        m.chain.replaced.append("skirtor2016.Mcl by 0.97")
    m.chain.definition = _definition(m)

    def covers(library):
        wanted = {name: got for name, (_, got) in values.items() if got is not None}
        lacks = library.missing(**wanted)
        return lacks and f"the library has not all values of {', '.join(lacks)}"

    kind, why = m.choose(c.Skirtor2016, c.ParametricTorus, covers)
    m.add(kind, values, why=why, **options)


def _definition(m):
    text = m.text("lambda_fracAGN", "0/0").replace(" ", "")
    try:
        low, high = (float(x) for x in text.split("/"))
    except ValueError:
        msg = f"skirtor2016.lambda_fracAGN must be two wavelengths as 3/1000, got {text!r}"
        raise ConfigError(msg) from None
    if (low, high) == (0.0, 0.0):
        return "dust"
    if (low, high) == (3.0, 1000.0):
        return "3-1000um"
    m.chain.replaced.append(f"skirtor2016.lambda_fracAGN = {text} by 0/0")
    return "dust"


def _xray(m):
    values = {"photon_index": ("gam", np.array([m.one("gam", 1.8)]))}
    for key in ("E_cut", "alpha_ox", "max_dev_alpha_ox", "angle_coef", "gam_lmxb", "gam_hmxb"):
        m.text(key)
    for key in ("det_lmxb", "det_hmxb"):
        m.text(key)
    m.chain.differs.append("xray: of the AGN alone, from L(6 um), without a part in the fit")
    if m.chain.modules.get("agn") is None:
        m.chain.left_out.append("xray (without skirtor2016)")
        return
    m.add(c.XRay, values)


def _redshifting(m):
    m.chain.redshift = m.numbers("redshift")
    m.add(c.Meiksin2006, {})


_MODULES = {
    "sfhdelayed": _sfhdelayed,
    "sfh2exp": _sfh2exp,
    "sfhfromfile": _sfhfromfile,
    "bc03": _bc03,
    "nebular": _nebular,
    "dustatt_calzleit": _calzleit,
    "dustatt_modified_starburst": _modified_starburst,
    "dustatt_modified_CF00": _modified_cf00,
    "dale2014": _dale2014,
    "casey2012": _casey2012,
    "dl2007": _dl2007,
    "skirtor2016": _skirtor2016,
    "xray": _xray,
    "redshifting": _redshifting,
}


def read_modules(names, parameters, *, folder, libraries):
    """
    Take modules for components.

    Parameters
    ----------
    names : list of str
        Modules of CIGALE, in order.
    parameters : dict of str to dict
        Their sections in ``pcigale.ini``.
    folder : `~pathlib.Path`
        Where files are that the modules name.
    libraries : {"best", "bundled"}
        Whether registered libraries are used.

    Returns
    -------
    chain : `Chain`

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If a value cannot be read, or no model comes of it.
    """
    chain = Chain()
    for name in names:
        if name not in _MODULES:
            chain.left_out.append(name)
            continue
        values = parameters.get(name, {})
        module = Module(name, values, chain, folder=folder, libraries=libraries)
        try:
            _MODULES[name](module)
        except ConfigError:
            raise
        except (ValueError, TypeError) as err:
            msg = f"[[{name}]]: {err}"
            raise ConfigError(msg) from err
        module.rest()
    have = {component.role for component in chain.components}
    lack = [role for role in ("sfh", "stellar") if role not in have]
    if "dust" in have and "attenuation" not in have:
        lack.append("attenuation")
    if lack:
        text = ", ".join(chain.left_out) or "none"
        msg = f"no module for {', '.join(lack)} is known here; left out: {text}"
        raise ConfigError(msg)
    return chain
