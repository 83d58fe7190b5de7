"""Best models in the layout of CIGALE's ``<id>_best_model.fits``: spectra part by part, and quantities."""

from pathlib import Path

import astropy.constants as const
import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import Table

from miricigale.cigale.names import AGN_PARTS, cigale_names
from miricigale.filters import Filter
from miricigale.filters.band_names import filter_of_band
from miricigale.fitting.results.drawing import best_parameters
from miricigale.sed.cosmology import distance
from miricigale.sed.xray_bands import SPAN, XRays, disk_2500
from miricigale.utils.files import make_folder, replacing
from miricigale.utils.options import check_that
from miricigale.utils.outputs import FILE_NAME, is_file_name

_LYMAN = 0.0912  # um
_LIGHT = 299792458.0  # m/s
_KEV_UM = (const.h * const.c).to_value(u.keV * u.um)
_XRAY_WAVE = _KEV_UM / np.geomspace(*SPAN[::-1], 1000)  # um
#: Ages of stars, and kinds of light of the gas that they ionize.
_AGES = ("old", "young")
_GAS_LIGHT = ("lines", "continuum")
_AGN_COLUMNS = {"torus": "torus", "polar": "polar_dust", "disk": "disk"}


def best_model_table(
    model, parameters, *, modules=None, bands=("B_B90", "V_B90", "FUV"), far=None, xray=None
):
    """
    Return one model in the layout of CIGALE's best models.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`
        The model.
    parameters : dict
        Values of its parameters, as for `~miricigale.sed.SEDModel.evaluate`.
    modules : dict of str to str, optional
        Role of a component to CIGALE's module, on which some names depend.
    bands : iterable of str, optional
        Bands, by CIGALE's names, of whose attenuation there is a quantity.
    far : `~astropy.units.Quantity`, optional
        Distance at which ``Fnu`` is; that of the redshift by default.
    xray : dict, optional
        Options of `~miricigale.sed.with_xray_bands`, for X-rays; ``alpha_ox`` is that of the model, NaN
        where its corona is not known.

    Returns
    -------
    table : `~astropy.table.Table`
        ``wavelength`` (nm, observed), ``Fnu`` (mJy), ``L_lambda_total`` and its parts (W/nm of observed
        wavelength; what is absorbed is negative), which sum to it: ``stellar.old`` and ``young``,
        ``nebular.absorption_*``, ``lines_*`` and ``continuum_*``, ``attenuation.*`` of each, ``dust``,
        ``agn.SKIRTOR2016_torus``, ``polar_dust`` and ``disk``, ``igm``; with ``xray`` also ``xray.galaxy``
        and, where ``alpha_ox`` is known, ``xray.agn``, in 0.25-1200 keV, without absorption. The meta hold
        quantities by CIGALE's names, in its units.

    Raises
    ------
    KeyError, ValueError
        As `~miricigale.sed.SEDModel.values`.

    Examples
    --------
    >>> from miricigale.cigale import best_model_table
    >>> from miricigale.sed import SEDModel
    >>> table = best_model_table(SEDModel.yang2021(), {"redshift": 0.05, "frac_agn": 0.4})
    >>> table.colnames[:4]
    ['wavelength', 'Fnu', 'L_lambda_total', 'stellar.old']
    >>> round(table.meta["agn.fracAGN"], 2)
    0.4
    """
    values = model.values(parameters)
    spectra = model.evaluate(**parameters)
    chain = model.chain
    derived = {name: quantity.value for name, quantity in spectra.derived.items()}
    stars, quantities = _stars(model, values)
    parts = {}
    for name, light in _galaxy_parts(chain, values, stars).items():
        parts[name] = values["mass"] * light
    parts["dust"] = derived["dust_luminosity"] * chain.dust(chain.key(values, "dust"))
    if model.has_agn:
        agn_parts, agn_quantities = _agn(model, values, derived)
        parts |= agn_parts
        quantities |= agn_quantities
    total = sum(parts.values())
    parts["igm"] = total * (chain.sky(values) - 1.0)
    quantities |= _attenuation(chain, parts, bands)
    wave = chain.wave
    if xray:
        wave = np.concatenate([_XRAY_WAVE, wave])
        parts = {name: np.pad(light, (_XRAY_WAVE.size, 0)) for name, light in parts.items()}
        disk = quantities.get("agn.intrin_Lnu_2500A_30deg", np.nan)
        bright, xray_columns = _xrays(xray, derived, values, disk)
        parts |= {name: np.pad(light, (0, chain.wave.size)) for name, light in bright.items()}
        quantities |= xray_columns
    z = values["redshift"]
    if far is None:
        source_distance = float(distance(z, model.cosmology))
    else:
        source_distance = float(far.to_value(u.m))
    for ours, (theirs, _, scale) in cigale_names(modules).items():
        if ours in derived:
            quantities[theirs] = scale * derived[ours]
        elif ours in values:
            quantities[theirs] = scale * values[ours]
    quantities["universe.age"] = model.cosmology.age(z).to_value(u.Myr)
    quantities["universe.luminosity_distance"] = source_distance
    table = _observed_table(wave, parts, z, source_distance)
    table.meta.update({name: float(value) for name, value in sorted(quantities.items())})
    return table


def _galaxy_parts(chain, values, stars):
    """Light of stars and gas and what dust takes of it, W/um for a solar mass formed: dict by CIGALE's names."""
    parts = {f"stellar.{age}": stars[age] for age in _AGES}
    has_gas = ("lines", "old") in stars
    escaping = np.where(chain.wave < _LYMAN, values.get("f_esc", 1.0), 1.0)
    young, old, of_gas = chain.factors(chain.key(values, "attenuation"))
    factor = {"young": young, "old": old}
    if has_gas:
        for age in _AGES:
            parts[f"nebular.absorption_{age}"] = stars[age] * (escaping - 1.0)
        for kind in _GAS_LIGHT:
            for age in _AGES:
                parts[f"nebular.{kind}_{age}"] = stars[kind, age]
    for age in _AGES:
        parts[f"attenuation.stellar.{age}"] = stars[age] * escaping * (factor[age] - 1.0)
    if has_gas:
        for kind in _GAS_LIGHT:
            for age in _AGES:
                through = of_gas
                if of_gas is None:
                    through = factor[age]
                parts[f"attenuation.nebular.{kind}_{age}"] = stars[kind, age] * (through - 1.0)
    return parts


def _agn(model, values, derived):
    """Return the light of the parts of an AGN in W/um, and its quantities: two dicts by CIGALE's names."""
    chain = model.chain
    nucleus = chain.agn(values)
    parts = {}
    quantities = {}
    for name, theirs in _AGN_COLUMNS.items():
        light = derived["agn_power"] * getattr(nucleus, name)
        parts[f"agn.SKIRTOR2016_{theirs}"] = light
        quantities[AGN_PARTS[name][1]] = float(chain.weights @ light)
    disk = derived["accretion_power"] * disk_2500(chain, model.component("agn"), values)
    quantities["agn.intrin_Lnu_2500A_30deg"] = disk
    return parts, quantities


def _observed_table(wave, parts, redshift, source_distance):
    """Return the table of parts in W/um at wavelengths in um, both at rest, as observed from a distance in m."""
    table = Table()
    table["wavelength"] = wave * (1.0 + redshift) * 1e3 * u.nm
    # W/um at rest to W/nm of observed wavelength
    to_observed = 1e-3 / (1.0 + redshift)
    luminosity = sum(parts.values()) * to_observed
    sphere = 4.0 * np.pi * source_distance**2
    fnu = luminosity * 1e9 * (table["wavelength"] * 1e-9) ** 2 / (_LIGHT * sphere)
    table["Fnu"] = np.asarray(fnu) * 1e29 * u.mJy
    table["L_lambda_total"] = luminosity * u.W / u.nm
    for name, light in parts.items():
        table[name] = light * to_observed * u.W / u.nm
    return table


def _xrays(options, derived, values, disk):
    """L_lambda of X-rays in W/um at rest, `_XRAY_WAVE`, of the galaxy and the corona; their quantities."""
    options = dict(options)
    slope = float(options.pop("alpha_ox", np.nan))
    xrays = XRays(**options)
    energy = _KEV_UM / _XRAY_WAVE
    names = ("sfr_100myr", "stellar_mass", "age_mass")
    sources = xrays.galaxy(*(derived[name] for name in names), values["metallicity"])
    per_um = energy / _XRAY_WAVE  # keV for each um
    light = {
        "xray.galaxy": sum(component.spectrum(energy) for component in sources.values()) * per_um
    }
    columns = {"xray.gam": xrays.photon_index, "xray.E_cut": xrays.cutoff.to_value(u.keV)}
    columns |= {"xray.det_lmxb": xrays.lmxb, "xray.det_hmxb": xrays.hmxb}
    if np.isfinite(slope * disk):
        sources["agn"] = corona = xrays.corona(disk, slope, values["inclination"])
        light["xray.agn"] = corona.spectrum(energy) * per_um
        columns["xray.alpha_ox"] = slope
    for name, component in sources.items():
        low, high = (f"{energy:g}".replace(".", "p") for energy in component.band)
        columns[f"xray.{name}_Lx_{low}to{high}keV"] = component.power
    return light, columns


def _stars(model, values):
    """Light of stars and gas for one solar mass formed, old and young, W/um; quantities of the stars."""
    chain = model.chain
    mass = values["mass"]
    stellar = model.component("stellar")
    nebular = model.component("nebular")
    history = model.component("sfh").history(values)
    age, spectra, surviving = stellar.table(values["metallicity"])
    rate = stellar.ionizing(values["metallicity"])
    nodes = np.asarray(stellar.nodes())
    out = {}
    columns = {}
    hard = chain.wave < _LYMAN
    for name, weights in zip(("young", "old"), stellar.age_weights(history, values), strict=True):
        light = np.interp(chain.wave, nodes, weights @ spectra, left=0.0, right=0.0)
        out[name] = light
        columns[f"stellar.m_star_{name}"] = mass * float(weights @ surviving)
        columns[f"stellar.n_ly_{name}"] = mass * float(weights @ rate)
        columns[f"stellar.lum_{name}"] = mass * float(chain.weights @ light)
        columns[f"stellar.lum_ly_{name}"] = mass * float((chain.weights * hard) @ light)
        if nebular is not None:
            pair = nebular.parts(age, weights, rate, values)
            for kind, part in zip(("continuum", "lines"), pair, strict=True):
                grid = np.asarray(nebular.nodes())
                out[kind, name] = np.interp(chain.wave, grid, part, left=0.0, right=0.0)
    for name in ("n_ly", "lum", "lum_ly"):
        columns[f"stellar.{name}"] = (
            columns[f"stellar.{name}_young"] + columns[f"stellar.{name}_old"]
        )
    return out, columns


def _attenuation(chain, parts, bands):
    """Return the attenuation of a galaxy's light in rest-frame bands, in mag."""

    def light(*starts):
        return sum(part for name, part in parts.items() if name.startswith(starts))

    before = light("stellar.", "nebular.")
    out = {}
    after = before + light("attenuation.")
    for band in filter(filter_of_band, bands):
        weights = Filter.from_name(filter_of_band(band)).weights(chain.wave) * chain.to_lnu
        out[f"attenuation.{band}"] = -2.5 * np.log10((weights @ after) / (weights @ before))
    return out


def write_best_models(results, folder, *, xray=None, overwrite=False):
    """
    Write the best model of every object as CIGALE does.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults`
        Results that know their model.
    folder : path-like
        Gets ``<id>_best_model.fits`` for each object that was fitted; made if it is not there.
    xray : dict, optional
        Options of `~miricigale.sed.with_xray_bands` with which the grid was made, for X-rays.
    overwrite : bool, optional
        Whether files that are there are replaced.

    Returns
    -------
    paths : list of `~pathlib.Path`

    Raises
    ------
    OSError
        If a file is there and ``overwrite`` is not given.
    ValueError
        If an id cannot be a part of a file's name, such as one with a slash.

    Examples
    --------
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"id": ["a", "b"], "redshift": [0.5, 1.0], "age": [1.0, 3.0], "mass": [1e10, 1e10]}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0))
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.4, 0.5, 0.9, 1.0, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    >>> fitter = BayesFitter(model, bands, axes=axes)
    >>> from tempfile import TemporaryDirectory
    >>> from miricigale.cigale import write_best_models
    >>> with TemporaryDirectory() as folder:
    ...     paths = write_best_models(fitter.fit(photometry), folder)
    >>> [path.name for path in paths]
    ['a_best_model.fits', 'b_best_model.fits']
    """
    folder = Path(folder)
    fitted = results[results.fitted]
    names = [str(best) for best in np.atleast_1d(fitted.ids)]
    for name in names:
        # an id such as ../a would be a file elsewhere
        check_that(
            is_file_name(name), "results", f"of ids that name files ({FILE_NAME})", repr(name)
        )
    paths = [folder / f"{name}_best_model.fits" for name in names]
    make_folder(folder)
    options = {"modules": results.meta.get("cigale", {}).get("modules")}
    for best, path in zip(fitted, paths, strict=True):
        if best.distance is not None:
            has_distance = np.isfinite(best.distance)
            if has_distance:
                options["far"] = float(best.distance) * u.Mpc
            else:
                options["far"] = None
        if xray:
            options["xray"] = xray | {"alpha_ox": float(best.best.get("alpha_ox", np.nan))}
        table = best_model_table(best.model, best_parameters(best, best.model), **options)
        meta = table.meta | {"best.chi_square": float(best.chi2)}
        table.meta = {}
        hdu = fits.table_to_hdu(table)
        for name, value in meta.items():
            hdu.header[f"HIERARCH {name}"] = value
        with replacing(path, overwrite=overwrite) as partial:
            hdu.writeto(partial)
    return paths
