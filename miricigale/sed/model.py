"""Models: components in a chain, from parameters to spectra and band fluxes."""

import functools
from collections.abc import Mapping

import astropy.units as u
import numpy as np

from miricigale.filters import FilterSet
from miricigale.refdata import citations
from miricigale.sed import gridding, parameter_names, presets, tables
from miricigale.sed.chain import INFRARED, Chain
from miricigale.sed.component import (
    chain_parameters,
    in_order,
    made_components,
    read_config,
)
from miricigale.sed.cosmology import COSMOLOGY
from miricigale.sed.derived import model_columns
from miricigale.sed.grid import fraction_span
from miricigale.sed.grid_cache import cached_grid
from miricigale.sed.parameter import default_values, parameter_table
from miricigale.utils.exceptions import argument_error, config_error, unknown_name
from miricigale.utils.interactive import Interactive, ValuesByName
from miricigale.utils.meta import provenance
from miricigale.utils.named_values import without_none
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import WAVE


class SEDModel(Interactive):
    """
    A model of spectra: a chain of components.

    ``model(redshift=1.0, ...)`` is `evaluate`.

    Parameters
    ----------
    components : iterable of `~miricigale.sed.Component` or str
        Components or their names, CIGALE's too (``"sfhdelayed"``). One of each role at most; a history (``sfh``)
        and populations (``stellar``) are needed, all other roles may be left out, but ``dust`` needs
        ``attenuation`` and ``xray`` needs ``agn``. They act in the order of their roles, whatever the order here.
    cosmology : `~astropy.cosmology.Cosmology`, optional
        For distances and the age of the universe.
    frac_agn_definition : {"dust", "3-1000um"} or str, optional
        What ``frac_agn`` f means: AGN dust emission over the sum with the galaxy's dust
        luminosity (CIGALE's default), or the AGN's share of all 3-1000 um light, or of another range
        of rest wavelengths such as ``"5-20um"``, within 0.1-1000 um.

    Attributes
    ----------
    preset : str or None
        ``"survey"`` or ``"yang2021"`` for a model that `survey` or `yang2021` made, which has axes of its own
        (`named_axes`); None for another one.

    Raises
    ------
    ValueError
        If a role that is needed is missing, one is there twice, or two components share a parameter name.

    Examples
    --------
    >>> from miricigale.sed import SEDModel
    >>> model = SEDModel.yang2021()
    >>> sed = model.evaluate(age=3.0, ebv=0.2, redshift=1.0, mass=1e10)
    >>> sed.redshift
    1.0
    """

    @takes_other_keywords
    def __init__(self, components=None, *, cosmology=COSMOLOGY, frac_agn_definition="dust"):
        wanted = "given; SEDModel.survey() and SEDModel.yang2021() have theirs"
        check_that(components is not None, "components", wanted, "None")
        self.components = in_order(components)
        fraction_span(frac_agn_definition)
        self.cosmology = cosmology
        self.frac_agn_definition = frac_agn_definition
        if self.has_agn and not self.component("attenuation") and frac_agn_definition == "dust":
            wanted = "'3-1000um' where nothing attenuates: there is no dust luminosity to refer to"
            raise argument_error("frac_agn_definition", wanted, "'dust'")
        self._parameters = chain_parameters(self.components)
        self._notes = ()
        self.preset = None

    # ------------------------------------------------------------------ making

    @classmethod
    def from_dict(cls, config):
        """
        Make a model from plain values, such as a section of a TOML file.

        Parameters
        ----------
        config : dict
            ``components``: list of dicts with ``name`` (see ``COMPONENTS.names()``) and new
            defaults of parameters; ``frac_agn_definition``: see the class.

        Raises
        ------
        `~miricigale.utils.exceptions.ConfigError`
            If a key, component or parameter is unknown.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> parts = [{"name": "delayed", "tau": 0.5}, {"name": "bc03"}, {"name": "smc"}]
        >>> SEDModel.from_dict({"components": parts})
        <SEDModel delayed -> bc03 -> smc>
        """
        parts, options = read_config(config)
        try:
            return cls(parts, **options)
        except ValueError as err:
            raise config_error("[sed]", f"{err}") from err

    @classmethod
    def yang2021(cls, *, agn=True, xray=False, igm="meiksin2006", libraries="best", **options):
        """
        Return the chain of Yang et al. 2021, from the best libraries at hand; ``meta`` names them.

        Delayed history, BC03 at solar metallicity, Calzetti-Leitherer attenuation, dust in a
        sequence of alpha, torus with SMC polar dust (oa 40 deg, i 70 deg, p 1, R 20,
        emissivity 1.6), intergalactic absorption; q 1 and one color excess for stars of all ages
        are inferred. BC03 files (the paper: Chabrier IMF), Dale et al. 2014 and SKIRTOR are used
        where they are registered (``miricigale data add``) and hold the paper's values; bundled
        tables stand in for what is not: BC03 with a Kroupa IMF, a Draine & Li sequence, a
        parametric torus.

        Parameters
        ----------
        agn : bool, optional
            Whether the chain has an AGN.
        xray : bool, optional
            Whether X-rays of the AGN are derived, as in the paper: Stern 2015, photon index 1.8,
            half of the 0.5-7 keV flux.
        igm : str, optional
            Name of the intergalactic component.
        libraries : {"best", "bundled"}, optional
            Whether registered libraries are used, or the bundled tables alone;
            ``meta["libraries"]`` says which and why.
        **options
            ``frac_agn_definition`` and ``cosmology``, as for the class.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> SEDModel.yang2021(libraries="bundled", igm="inoue2014")
        <SEDModel delayed -> bc03 -> calzetti -> dl07_alpha -> parametric_torus -> inoue2014>
        """
        preset = presets.yang2021_components(agn=agn, xray=xray, igm=igm, libraries=libraries)
        return cls._of_preset("yang2021", preset, options)

    @classmethod
    def survey(cls, *, agn=True, igm="meiksin2006", libraries="best", **options):
        """
        Return a chain for real galaxies of a survey, to be fitted with `survey_axes`.

        The chain of `yang2021` with lines and continuum of the gas (log U -2.5), a burst of 30 Myr ago,
        old stars with 0.44 of the color excess of young ones and of the gas (Calzetti et al. 2000), and the
        dust of Draine & Li 2007 for its mass fraction in PAHs, with a fifth of its 3.3 um feature: that has
        0.8 % of the infrared light in templates rich in PAHs, and about 0.1 % in galaxies (Lai et al. 2020).

        Parameters
        ----------
        agn, igm, libraries, **options
            As for `yang2021`.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> SEDModel.survey(libraries="bundled", agn=False)
        <SEDModel delayed -> bc03 -> nebular -> calzetti -> dl07 -> meiksin2006>
        """
        preset = presets.survey_components(agn=agn, igm=igm, libraries=libraries)
        return cls._of_preset("survey", preset, options)

    @classmethod
    def _of_preset(cls, name, components, options):
        parts, notes = components
        model = cls(parts, **options)
        model._notes = tuple(notes)
        model.preset = name
        return model

    @classmethod
    def for_axes(cls, name="survey"):
        """
        Return the model that a grid of ours is made of.

        Parameters
        ----------
        name : {"survey", "far-infrared", "yang2021", "yang2021-quick"}, optional
            Name of the grid.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> SEDModel.for_axes("far-infrared").preset
        'survey'
        """
        preset = presets.GRIDS[presets.grid_name(name, "name")][0]
        if preset == "survey":
            return cls.survey()
        return cls.yang2021()

    def with_components(self, *components):
        """
        Return the model of the same chain with more components, such as dust of the Milky Way.

        Parameters
        ----------
        *components : `~miricigale.sed.Component`
            Of roles that the chain does not have.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> from miricigale.sed import GalacticExtinction
        >>> model = SEDModel.survey().with_components(GalacticExtinction(ebv_galactic=0.02))
        >>> model.preset
        'survey'
        """
        model = self._of_components([*self.components, *components])
        model._notes = self._notes
        model.preset = self.preset
        return model

    def replace(self, *components):
        """
        Return the model with other components, each in the place of the one of its role.

        Parameters
        ----------
        *components : `~miricigale.sed.Component` or str
            Components, or names of some with their defaults. One of a role that the chain lacks is added.

        Returns
        -------
        model : `SEDModel`
            Without ``preset``: the axes of that are of other components.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> SEDModel.yang2021(libraries="bundled", agn=False).replace("smc")
        <SEDModel delayed -> bc03 -> smc -> dl07_alpha -> meiksin2006>
        """
        new = {component.role: component for component in made_components(components)}
        unchanged = [component for component in self.components if component.role not in new]
        return self._of_components([*unchanged, *new.values()])

    def _of_components(self, components):
        """Return the model of other components, with the cosmology and the AGN fractions of this one."""
        return type(self)(
            components, cosmology=self.cosmology, frac_agn_definition=self.frac_agn_definition
        )

    def named_axes(self, name=None):
        """
        Return the axes of a grid of this model by name.

        Parameters
        ----------
        name : {"survey", "far-infrared", "yang2021", "yang2021-quick"}, optional
            The grid; by default that of its own name of a model that `survey` or `yang2021` made. Axes of AGN
            are left out for a model without.

        Returns
        -------
        axes : dict of str to `~numpy.ndarray`
            In the units of the parameters; to be changed at will.

        Raises
        ------
        ValueError
            If there is no grid of that name, it is one of another chain, or no name was given for a model that
            has no grid of its own.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> SEDModel.survey(agn=False).named_axes()["metallicity"]
        array([0.004, 0.02 ])
        """
        return presets.axes_of_preset(self.preset, name, agn=self.has_agn)

    survey_axes = staticmethod(presets.survey_axes)
    yang2021_axes = staticmethod(presets.yang2021_axes)

    # -------------------------------------------------------------- description

    @property
    def parameters(self):
        """All parameters, in the order of the chain: dict of name to `Parameter`."""
        return ValuesByName(self._parameters)

    @property
    def defaults(self):
        """Default of every parameter in its unit: dict of name to float."""
        return ValuesByName(default_values(self._parameters))

    def to_table(self):
        """
        Tabulate the parameters.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``name``, ``default``, ``low`` and ``high`` (bounds), ``unit`` and ``description`` of each.
        """
        return parameter_table(self._parameters)

    def component(self, role):
        """Return the component of a role (one of `~miricigale.sed.ROLES`), or None."""
        return next((c for c in self.components if c.role == role), None)

    def __getitem__(self, name):
        """Return the component of a name, role or number."""
        if isinstance(name, (int, np.integer)):
            return self.components[name]
        component = next((c for c in self.components if name in (c.name, c.role)), None)
        if component is None:
            raise unknown_name("component", name, [c.name for c in self.components])
        return component

    def _ipython_key_completions_(self):
        """Return what a session offers in brackets: names of the components and their roles."""
        names = []
        for component in self.components:
            names += [component.name, component.role]
        return list(dict.fromkeys(names))

    @property
    def has_agn(self):
        """Whether the chain has an AGN."""
        return self.component("agn") is not None

    @property
    def resources(self):
        """Names of the reference data that the components read."""
        return tuple(c.resource for c in self.components if c.resource)

    @property
    def recipe(self):
        """Components with their libraries and options, IMF, definition and cosmology, in words."""
        options = [f"{c.name}: {n} = {v}" for c in self.components for n, v in c.settings.items()]
        out = {
            "components": [f"{c.role}: {c.name} ({c.library})" for c in self.components],
            "options": options or None,
            "imf": self.component("stellar").imf,
            "frac_agn_definition": self.frac_agn_definition if self.has_agn else None,
            "cosmology": f"H0={self.cosmology.H0.value:g}, Om0={self.cosmology.Om0:g}",
        }
        return without_none(out)

    @property
    def meta(self):
        """Libraries, citations and definitions: a dict that fits into any header."""
        cite = [*citations(*self.resources), *(c.reference for c in self.components)]
        notes = list(self._notes) or None
        return provenance(citations=filter(None, cite), libraries=notes, **self.recipe)

    @functools.cached_property
    def chain(self):
        """The components on their common grid of wavelengths (made on first use)."""
        span = fraction_span(self.frac_agn_definition) or INFRARED
        return Chain({c.role: c for c in self.components}, span=span)

    @property
    def wave(self):
        """Rest wavelengths at which the spectra are evaluated."""
        return self.chain.wave * WAVE

    def derived_columns(self):
        """
        Return the derived quantities that come with every evaluation.

        Returns
        -------
        columns : dict of str to `~miricigale.sed.Derived`
            Unit and description by name.
        """
        return model_columns(self.has_agn, self.component("xray"))

    def __getstate__(self):
        state = self.__dict__.copy()
        state.pop("chain", None)
        return state

    def __repr__(self):
        return f"<SEDModel {' -> '.join(c.name for c in self.components)}>"

    def _facts(self):
        return {component.role: repr(component) for component in self.components}

    # --------------------------------------------------------------- evaluation

    def values(self, parameters):
        """
        Check parameters and fill in the defaults.

        Parameters
        ----------
        parameters : dict
            Quantities, or numbers in the declared units.

        Returns
        -------
        values : dict of str to float

        Raises
        ------
        KeyError
            If a name is not known.
        ValueError
            If a value is outside its bounds, or the galaxy older than the universe.
        """
        parameters = parameter_names.by_our_names(parameters, self._parameters, short=True)
        parameters = tables.with_mass_formed(self, parameters)
        parameter_names.check_parameters(parameters, self)
        values = self.defaults
        for name, value in parameters.items():
            wanted = "one number (fluxes() takes several models)"
            check_that(np.ndim(value) == 0, name, wanted, f"shape {np.shape(value)}")
            values[name] = self._parameters[name].check(value)
        for component in self.components:
            refusal = component.invalid(values)
            if refusal:
                raise ValueError(refusal)
        limit = float(self.cosmology.age(values["redshift"]).to_value(u.Gyr))
        wanted = f"at most the age of the universe, {limit:.3f} Gyr"
        check_that(values["age"] <= limit, "age", wanted, values["age"])
        return values

    def evaluate(self, values=None, /, **parameters):
        """
        Return the spectrum of one model.

        Parameters
        ----------
        values : dict, optional
            Parameters by name, in place of keywords or beside them.
        **parameters
            Any of `parameters`, as quantities or numbers in their units; or parameters of CIGALE, such as
            ``tau_main`` or ``sfh.tau_main``, whose numbers are in CIGALE's units (Myr). ``mass`` is the mass
            formed; ``stellar_mass``, that of living stars, can stand in its place. Arrays, all of one length,
            are several models.

        Returns
        -------
        sed : `SED`, or list of `SED` where a parameter is an array
            As observed, with its ``components``, ``parameters`` and ``derived`` quantities.

        Raises
        ------
        KeyError, ValueError
            See `values`.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> model = SEDModel.yang2021(libraries="bundled")
        >>> sed = model.evaluate(age=3.0, ebv=0.2, frac_agn=0.3, redshift=1.0, mass=3e10)
        >>> sorted(sed.components)
        ['agn_disk', 'agn_polar', 'agn_torus', 'dust', 'stellar', 'stellar_intrinsic']
        >>> print(f"{sed.derived['sfr_100myr']:.2f}")
        5.79 solMass / yr
        """
        parameters = parameter_names.merged(values, parameters, self.parameters)
        if any(np.ndim(value) == 1 for value in parameters.values()):
            return [self.evaluate(model) for model in parameter_names.single_models(parameters)]
        return tables.spectra(self, self.values(parameters))

    __call__ = evaluate

    def derived(self, **parameters):
        """Return the derived quantities of one model: dict of name to `~astropy.units.Quantity`."""
        return tables.spectra(self, self.values(parameters)).derived

    def plot(self, ax=None, **parameters):
        """Draw the spectrum of one model, see `evaluate` and `SED.plot`; returns the axes."""
        return tables.spectra(self, self.values(parameters)).plot(ax=ax)

    def fluxes(self, table=None, filters=None, **parameters):
        """
        Return the band fluxes of any list of models, at their own redshifts.

        Parameters
        ----------
        table : `~astropy.table.Table`, dict, `pandas.DataFrame` or path-like
            A row for each model; columns by parameter name, the defaults where there is
            none; ``redshift`` is needed. ``stellar_mass``, that of living stars, counts where there is no
            ``mass``, the mass formed. Other columns are left alone.
        filters : `~miricigale.filters.FilterSet` or list of str
            The bands.
        **parameters
            Numbers or arrays of one shape by parameter name, in place of a table:
            ``model.fluxes(["F770W"], redshift=[0.5, 1.0])``.

        Returns
        -------
        fluxes : `~astropy.table.QTable`
            ``id`` if the input has it, a column in uJy for each band, derived quantities and
            ``flags`` (`~miricigale.sed.ModelFlags`); a row that cannot be evaluated is flagged and
            holds NaN, a band that the spectrum does not cover is NaN and its row flagged.

        Raises
        ------
        ValueError
            If it is no table or has no redshift.
        `~astropy.units.UnitsError`
            If a column has a wrong unit.

        Warns
        -----
        `~miricigale.utils.exceptions.ModelWarning`
            If a column's name is within a letter or two of a parameter's.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> model = SEDModel.yang2021(libraries="bundled")
        >>> rows = {"redshift": [0.5, 1.0], "age": [3.0, 3.0], "ebv": [0.1, 0.3]}
        >>> model.fluxes(rows, ["miri.f770w"])["miri.f770w"].round(2)
        <Quantity [6.57, 2.42] uJy>
        """
        table, filters = parameter_names.named_first(table, filters, parameters, "table")
        if parameters:
            parameters = parameter_names.by_our_names(parameters, self._parameters, short=True)
            parameter_names.check_parameters(parameters, self)
            table = parameter_names.parameter_table(parameters)
        for name, value in (("table", table), ("filters", filters)):
            check_that(value is not None, name, "given, or parameters by name", "None")
        return tables.flux_table(self, table, self._bands(filters))

    def grid(self, axes=None, filters=None, *, cache=True, **values):
        """
        Return the factorised band fluxes of a grid of models.

        Parameters
        ----------
        axes : dict of str to array, str or None
            Parameter name to its values, or a name for `named_axes` (None: its own grid); ``redshift`` is needed,
            ``mass`` and parameters of X-rays and the foreground have no place here. Other parameters have their
            defaults: with ``dust_excess`` the dust's luminosity is free of energy balance. With no ``frac_agn``
            but 0 the grid has no AGN.
        filters : `~miricigale.filters.FilterSet` or list of str or `~miricigale.filters.Filter`
            The bands. They may stand before a dict of axes.
        **values
            Values of axes by name, in place of a dict: ``model.grid(["F770W"], redshift=[0.5, 1.0])``.
        cache : bool, optional
            Whether a grid of the same content (axes, bands, components, data, cosmology, code)
            is taken from the cache folder, and a new one kept there.

        Returns
        -------
        grid : `~miricigale.sed.ModelGrid`

        Raises
        ------
        KeyError
            If an axis is not a parameter.
        ValueError
            If values do not ascend, are outside their bounds or not in the library.

        Warns
        -----
        `~miricigale.utils.exceptions.ModelWarning`
            If a band is beyond 30 um at rest, and ``u_min`` of the dust has one value.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> model = SEDModel.yang2021(libraries="bundled")
        >>> axes = {"redshift": [0.5, 1.0], "ebv": [0.1, 0.3, 0.5]}
        >>> model.grid(axes, ["miri.f770w"], cache=False)
        <ModelGrid 2 redshifts x 3 galaxies x 0 AGN x 1 fractions, 1 bands, 6 models>
        """
        axes, filters = parameter_names.named_first(axes, filters, values, "axes")
        if isinstance(filters, Mapping):
            # bands first, as fitters have them
            axes, filters = filters, axes
        check_that(filters is not None, "filters", "given", "None")
        if axes is None or isinstance(axes, str):
            axes = self.named_axes(axes)
        axes = gridding.check_axes(self, axes)
        filters = self._bands(filters)
        gridding.warn_of_one_field(self, axes, filters)
        if not cache:
            return gridding.model_grid(self, axes, filters)
        return cached_grid(self, axes, filters, gridding.model_grid)

    def _bands(self, filters):
        if not isinstance(filters, FilterSet):
            filters = FilterSet(filters)
        if foreground := self.component("foreground"):
            foreground.check_bands(filters)
        return filters
