"""Chains and axes for surveys and after published studies, with what stands in where libraries are missing."""

import numpy as np
from astropy.utils.exceptions import AstropyDeprecationWarning

from miricigale.refdata import find_resource
from miricigale.sed import components as c
from miricigale.sed.component import COMPONENTS
from miricigale.utils.exceptions import argument_error, warn
from miricigale.utils.named_values import convert_values, without
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import declared

#: Where a preset takes its libraries from.
LIBRARIES = ("best", "bundled")

#: Chains by the names of the grids that are made of them, and the tables of their axes.
GRIDS = {
    "survey": ("survey", "survey_axes"),
    "far-infrared": ("survey", "far_infrared_axes"),
    "yang2021": ("yang2021", "yang2021_fit"),
    "yang2021-quick": ("yang2021", "yang2021_quick"),
}
#: Names that grids once had.
_FORMER = {"fit": "yang2021", "quick": "yang2021-quick"}
#: Parameters of grids that only a chain with an AGN has.
_OF_AGN = frozenset({"tau97", "ebv_polar", "temperature_polar", "frac_agn"})

#: AGN templates of the fits of Yang et al. 2021 (table 1; q is inferred).
TORUS = {"p": 1.0, "q": 1.0, "opening_angle": 40.0, "radius_ratio": 20.0}

#: Strength of the 3.3 um feature of the dust of a survey's galaxies, over that of Draine & Li 2007. With it the
#: feature has 0.12 % of the light at 8-1000 um for q_PAH 3.4 %, that of galaxies of half solar metallicity and
#: more (Shivaei et al. 2024, A&A 690, A89); spectra of star-forming galaxies have about 0.1 % (Lai et al. 2020,
#: ApJ 905, 55). The templates of Dale et al. 2014 have 0.23 to 0.30 of the feature of Draine & Li at the same
#: 5-25 um light.
PAH_33 = 0.2


def yang2021_components(*, agn, xray, igm, libraries):
    """
    Return the components of the chain of Yang et al. 2021, and which library each part comes from.

    Parameters are those of `SEDModel.yang2021`. Of the paper are the libraries' kinds and the values
    of its table 1; ``q`` and one color excess for stars of all ages are inferred.
    """
    choose, notes = _chooser(libraries)

    parts = [
        c.DelayedSFH(),
        _stars(choose, [0.02]),
        c.CalzettiLeitherer(),
        choose("dust", c.Dale2014(), c.DraineLi2007Alpha(), lambda _: None),
        COMPONENTS.get(igm)(),
    ]
    if agn:
        parts.append(_torus(choose, yang2021_axes("fit")))
    if xray:
        parts.append(c.XRay(xray_transmission=0.5))
    return parts, notes


def survey_components(*, agn, igm, libraries):
    """
    Return the components of the chain for galaxies of a survey, and which library each part comes from.

    Parameters are those of `SEDModel.survey`. Against `yang2021_components` there are the gas's lines and
    continuum, a burst, two metallicities, old stars with 0.44 of the color excess of young ones, and dust
    whose mass fraction in PAHs varies: real galaxies have less light at 3-12 um than dust rich in PAHs that
    absorbs as much. Its 3.3 um feature is `PAH_33` of that of the templates, as in spectra of galaxies.
    """
    choose, notes = _chooser(libraries)

    parts = [
        c.DelayedSFH(age_burst=0.03, tau_burst=0.05),
        _stars(choose, survey_axes()["metallicity"]),
        c.Nebular(log_u=-2.5),
        c.CalzettiLeitherer(ebv_factor=0.44),
        c.DraineLi2007(pah_33=PAH_33),
        COMPONENTS.get(igm)(),
    ]
    if agn:
        parts.append(_torus(choose, survey_axes()))
    return parts, notes


def _chooser(libraries):
    """Return the function that takes the better of two libraries if it is at hand, and notes on what it took."""
    check_that(libraries in LIBRARIES, "libraries", f"one of {LIBRARIES}", repr(libraries))
    notes = []

    def choose(part, better, bundled, covers):
        if libraries == "bundled":
            why = ", as asked"
        elif find_resource(better.resource) is None:
            why = f"; {better.resource} is not registered"
        else:
            lacks = covers(better)
            if lacks:
                why = f"; {better.resource} {lacks}"
            else:
                why = ""
        if why:
            component = bundled
        else:
            component = better
        notes.append(f"{part}: {component.resource}{why}")
        return component

    return choose, notes


def _stars(choose, metallicities):
    def covers(library):
        refusals = (library.invalid({"metallicity": z}) for z in metallicities)
        return next(filter(None, refusals), None)

    return choose("stars", c.BC03Library(), c.BC03(), covers)


def _torus(choose, axes):
    """Return the torus of the paper's shape with the optical depths of some axes."""

    def covers(library):
        points = [TORUS | {"tau97": t, "inclination": 70.0} for t in axes["tau97"]]
        why = next(filter(None, map(library.invalid, points)), None)
        return why and f"lacks the paper's torus: {why}"

    return choose("torus", c.Skirtor2016(**TORUS), c.ParametricTorus(**TORUS), covers)


def yang2021_axes(kind="fit"):
    """
    Return the axes after the grids of Yang et al. 2021 (tables 1 and 3).

    Parameters
    ----------
    kind : {"fit", "galaxy", "quick"}
        ``"fit"``: the grid of the fits, 560 galaxies, 60 AGN (50 different ones: temperatures make no difference
        without polar dust), 11 fractions, 65 redshifts; ``"galaxy"``: the same without AGN; ``"quick"``: a thinner
        one, not the paper's, 96 galaxies, 12 AGN (9 different ones; polar dust at 100 and 300 K), 6 fractions, 33
        redshifts.

    Returns
    -------
    axes : dict of str to `~numpy.ndarray`
        In the units of the parameters (Gyr, mag, K); to be changed at will.

    Examples
    --------
    >>> from miricigale.sed import yang2021_axes
    >>> axes = yang2021_axes("quick")
    >>> axes["tau"], axes["frac_agn"]
    (array([0.1, 1. , 5. ]), array([0.  , 0.2 , 0.4 , 0.6 , 0.8 , 0.99]))
    """
    check_that(kind in ("fit", "galaxy", "quick"), "kind", "'fit', 'galaxy' or 'quick'", repr(kind))
    return _values(f"yang2021_{kind}")


def survey_axes(kind="survey"):
    """
    Return the axes for galaxies of a survey: what redshifts, masses and AGN fractions of real galaxies need.

    Histories of three time scales and seven ages from 50 Myr, without a burst or with one of 30 Myr ago that
    made 3 or 30 % of the stars; 0.2 solar and solar metallicity of stars and gas; two slopes of attenuation;
    color excesses from 0; dust poor and rich in PAHs. Redshifts to 10 in steps of 0.02 in ln(1 + z), half of the
    scatter of photometric redshifts. 4032 galaxies, six AGN, seven fractions.

    All have one least intensity of starlight, U_min = 1, and so one temperature of the cold dust: for data with
    bands beyond 30 um at rest take ``kind="far-infrared"``.

    Parameters
    ----------
    kind : {"survey", "far-infrared"}, optional
        ``"far-infrared"``: dust at four U_min, three gamma and three q_PAH, flatter slopes of attenuation, color
        excesses from 0.1, no bursts; 15,552 galaxies, one AGN, four fractions. For a model error of 10 % of the
        flux: the template error of `~miricigale.fitting.SurveyCalibration.survey` was measured to 8 um and gives
        far-infrared bands no weight.

    Returns
    -------
    axes : dict of str to `~numpy.ndarray`
        In the units of the parameters (Gyr, mag, K); to be changed at will.

    Examples
    --------
    >>> from miricigale.sed import survey_axes
    >>> axes = survey_axes()
    >>> axes["tau"], axes["f_burst"], axes["redshift"].size
    (array([0.1, 0.5, 3. ]), array([0.  , 0.03, 0.3 ]), 121)
    >>> survey_axes("far-infrared")["u_min"]
    array([ 0.5,  2. ,  8. , 25. ])
    """
    check_that(kind in ("survey", "far-infrared"), "kind", "'survey' or 'far-infrared'", repr(kind))
    return _values(f"{kind.replace('-', '_')}_axes")


def quasar_axes():
    """
    Return the axes of type-1 AGN that outshine their galaxies, for the chain of `SEDModel.survey`.

    Disks seen at 30 deg, three slopes of them (L_lambda ~ wave^-1.8 to wave^-1.2), behind polar dust of E(B-V) 0
    to 0.4, and tori of three depths; AGN fractions from 0.7, of two young hosts with E(B-V) 0.2; the redshifts of
    `survey_axes`. The disk has no broad lines, which add up to some 10 % to a broad band.

    Returns
    -------
    axes : dict of str to `~numpy.ndarray`
        In the units of the parameters (Gyr, mag, deg, K); to be changed at will.

    Examples
    --------
    >>> from miricigale.sed import quasar_axes
    >>> axes = quasar_axes()
    >>> axes["ebv_polar"], axes["frac_agn"]
    (array([0.  , 0.05, 0.1 , 0.2 , 0.4 ]), array([0.7  , 0.85 , 0.93 , 0.97 , 0.99 , 0.997]))
    """
    return _values("quasar_axes")


def grid_name(name, argument="axes"):
    """
    Name of a grid in `GRIDS`, of which that or a former one is given.

    Raises
    ------
    ValueError
        If no grid has that name.

    Warns
    -----
    `~astropy.utils.exceptions.AstropyDeprecationWarning`
        Of a former name.
    """
    if name in _FORMER:
        current = _FORMER[name]
        warn(f"{argument} {name!r} is now called {current!r}", AstropyDeprecationWarning)
        return current
    if name not in GRIDS:
        wanted = f"a dict of parameter name to values, or one of {', '.join(map(repr, GRIDS))}"
        raise argument_error(argument, wanted, repr(name))
    return name


def axes_of_preset(preset, name=None, *, agn):
    """
    Return the axes of a grid of a model of a preset; see `SEDModel.named_axes`.

    ``preset`` is None of a model that has no grid of its own, and ``name`` that of the grid, by default that of
    the preset.
    """
    names = [grid for grid, (chain, _) in GRIDS.items() if chain == preset]
    if name is None:
        wanted = "given for a model that has no grid of its own: a dict of its parameters to values"
        check_that(names, "axes", wanted, "None")
        name = preset
    name = grid_name(name)
    if names and name not in names:
        named = ", ".join(map(repr, names))
        wanted = f"{named} or a dict of parameters to values for the model {preset!r}"
        raise argument_error("axes", wanted, repr(name))
    return grid_axes(name, agn=agn)


def grid_axes(name, *, agn):
    """Return the axes of a grid in `GRIDS`: new arrays by parameter; without those of AGN if ``agn`` is false."""
    axes = _values(GRIDS[name][1])
    if agn:
        return axes
    return without(axes, _OF_AGN)


def red_dot_axes():
    """
    Axes of little red dots: parameters of `red_dot` over the range of published spectra, and redshifts of 2 to 10.

    Temperatures and widths of H alpha have the values of 5 to 95 and 16 to 84 % of the spectra of de Graaff et al.
    2025 (arXiv:2511.21820). Gas of an optical depth of 2 at the Balmer limit covers none, half or all of the
    envelope. The galaxy has 2.5 to 80 % of the light of the envelope, in steps of a factor of two.

    Returns
    -------
    axes : dict of str to `~numpy.ndarray`
        In the units of the parameters (K, Angstrom); to be changed at will. Redshifts have the steps of
        `survey_axes`.

    Examples
    --------
    >>> from miricigale.sed import red_dot_axes
    >>> axes = red_dot_axes()
    >>> axes["temperature"], axes["redshift"][[0, -1]].round(2)
    (array([3500., 4300., 5200., 6300.]), array([ 2.  , 10.01]))
    """
    return _values("red_dot_axes")


def _values(name):
    """Return the new arrays of a table of ``presets.toml``; redshifts are even in ln(1 + z)."""
    table = dict(declared("miricigale.sed", "presets.toml")[name])
    step = table.pop("redshift", None)
    out = convert_values(np.array, table)
    if step is None:
        return out
    return out | {"redshift": _redshifts(**step)}


def _redshifts(step, first, last):
    n = int(np.floor(np.log((1.0 + last) / (1.0 + first)) / step)) + 1
    return (1.0 + first) * np.exp(step * np.arange(n)) - 1.0
