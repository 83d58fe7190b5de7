"""The base of all components of a model, and their registry."""

import functools
from collections.abc import Mapping

import astropy.units as u

from miricigale.refdata import Registry, locate
from miricigale.refdata.lookup import fingerprint_of
from miricigale.sed.parameter import MODEL_PARAMETERS, Parameter
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import ConfigError, argument_error, config_error
from miricigale.utils.named_values import subset, without
from miricigale.utils.options import check_that

#: What a component does, in the order in which light meets it.
ROLES = ("sfh", "stellar", "nebular", "attenuation", "dust", "agn", "xray", "igm", "foreground")

#: Components by name, for configurations.
COMPONENTS = Registry("component")


#: Modules of CIGALE: the components that they are here, where the names differ.
CIGALE_MODULES = {
    "sfhdelayed": "delayed",
    "sfh2exp": "double_exponential",
    "dustatt_calzleit": "calzetti",
    "dustatt_modified_starburst": "modified_starburst",
    "dustatt_modified_CF00": "charlot_fall",
    "dl2007": "dl07",
    "yang20": "xray",
    "redshifting": "meiksin2006",
}
#: Modules of CIGALE that have no component, and the components that come closest.
_NEAREST_TO_CIGALE = {
    "sfhfromfile": "sfh_table",
    "m2005": "bc03",
    "dustatt_2powerlaws": "charlot_fall",
    "dl2014": "dl07",
    "themis": "dl07",
    "fritz2006": "skirtor2016",
}
#: Options of components that are those of CIGALE's modules.
_CIGALE_OPTIONS = {"dustatt_calzleit": {"ebv_scaling": "cigale"}}


def named_component(name, **defaults):
    """
    Make a component by its name, or that of CIGALE's module.

    Parameters
    ----------
    name : str
        One of ``COMPONENTS.names()`` or of `CIGALE_MODULES`, whose conventions its component then has.
    **defaults
        As for the component.

    Raises
    ------
    KeyError
        If there is no component of the name; for a role the message lists its components.
    """
    if name in ROLES and name not in COMPONENTS:
        names = [n for n in COMPONENTS.names() if COMPONENTS.metadata(n)["role"] == name]
        msg = f"{name!r} is a role; its components are {', '.join(names)}"
        raise KeyError(msg)
    if name in _NEAREST_TO_CIGALE and name not in COMPONENTS:
        nearest = _NEAREST_TO_CIGALE[name]
        msg = (
            f"no component {name!r}: the component closest to this module of CIGALE is {nearest!r}"
        )
        raise KeyError(msg)
    options = _CIGALE_OPTIONS.get(name, {}) | defaults
    return COMPONENTS.get(CIGALE_MODULES.get(name, name))(**options)


def register(cls):
    """
    Class decorator: make a component known by its ``name``.

    A class of the same module and name takes the place of the former: a notebook's cell may be
    run again.

    Raises
    ------
    ValueError
        If it has no name, no known role, or the name of another component.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed import COMPONENTS, Parameter, register
    >>> from miricigale.sed.components import Attenuation
    >>> @register
    ... class Gray(Attenuation):
    ...     name = "gray_example"
    ...     tau = Parameter(0.5, (0.0, 10.0), "Optical depth at all wavelengths.")
    ...
    ...     def factors(self, wave, values):
    ...         factor = np.full(wave.shape, np.exp(-values["tau"]))
    ...         return factor, factor
    >>> COMPONENTS.get("gray_example")(tau=1.0)
    Gray(tau=1)
    """
    check_that(cls.name, "name", "a name", f"{cls.name!r} of {cls.__name__}")
    check_that(
        cls.role in ROLES, "role", f"one of {', '.join(ROLES)}", f"{cls.role!r} of {cls.__name__}"
    )
    is_redefined = False
    if cls.name in COMPONENTS:
        old = COMPONENTS.get(cls.name)
        is_redefined = (old.__module__, old.__qualname__) == (cls.__module__, cls.__qualname__)
    COMPONENTS.register(
        cls.name, lambda _: cls, replace=is_redefined, role=cls.role, reference=cls.reference
    )
    return cls


class Component:
    """
    One link in the chain of a model.

    A subclass gives ``name``, ``role`` (one of `ROLES`), ``reference`` (what to cite) and
    declares its parameters as `~miricigale.sed.Parameter` in the class body. Numbers go in
    and arrays come out; units are the model's business. Choices that are names and not
    numbers, such as a law, are `options`: fixed when the component is made. A change of the code
    that changes the spectra raises ``version``, so that grids kept on the disk are made anew.

    Parameters
    ----------
    **defaults
        New defaults of parameters, as quantities or bare numbers in the declared unit, and
        values of options.

    Raises
    ------
    TypeError
        If a name is neither a parameter nor an option.
    ValueError
        If a value is outside its bounds or not one of the option's.

    Examples
    --------
    >>> from miricigale.sed.components import DraineLi2007
    >>> dust = DraineLi2007(q_pah=1.12)
    >>> dust
    DraineLi2007(u_min=1, gamma=0.02, q_pah=1.12, pah_33=1)
    >>> dust.parameters["q_pah"].bounds
    (0.47, 4.58)
    """

    name = ""
    role = ""
    reference = ""
    resource = None

    #: Version of the numbers that this class is responsible for; kept grids of others are not
    #: taken. A subclass that states its own has it besides those of its bases.
    version = 1

    #: Packages whose numbers the component takes over, such as curves of extinction.
    packages = ()

    #: Parameters of other components that this one looks at.
    others = ()

    #: Parameter in which the light for one solar mass formed is a straight line, "" if there is none.
    linear = ""

    #: Options of this class: name to the values allowed, the first being the default.
    options = {}

    def __init__(self, **defaults):
        parameters = type(self).declared()
        options = type(self).all_options()
        self.__dict__.update({name: values[0] for name, values in options.items()})
        for name, value in defaults.items():
            if name in options:
                check_that(
                    value in options[name], name, f"one of {', '.join(options[name])}", repr(value)
                )
            elif name in parameters:
                value = parameters[name].check(value)
            else:
                names = ", ".join(list(parameters) + list(options))
                msg = f"{type(self).__name__} has no parameter {name!r}; known: {names}"
                raise TypeError(msg)
            self.__dict__[name] = value

    def __setattr__(self, name, value):
        if name in type(self).all_options():
            msg = f"option {name!r} is set when the component is made"
            raise AttributeError(msg)
        super().__setattr__(name, value)

    @classmethod
    @cached
    def declared(cls):
        """Return the parameters as declared in the class bodies, base classes first."""
        bodies = [vars(base).items() for base in reversed(cls.__mro__)]
        return {k: v for body in bodies for k, v in body if isinstance(v, Parameter)}

    @classmethod
    def all_options(cls):
        """Return the options as declared in the class bodies: dict of name to the values allowed."""
        bodies = [vars(base).get("options", {}) for base in reversed(cls.__mro__)]
        return {name: values for body in bodies for name, values in body.items()}

    @property
    def settings(self):
        """Options as chosen, and whatever else than parameters shapes the spectra: dict."""
        return subset(self.__dict__, type(self).all_options())

    @property
    def parameters(self):
        """Parameters with the defaults of this instance: dict of name to Parameter."""
        return dict(self._parameters)

    @functools.cached_property
    def _parameters(self):
        """What `parameters` is a copy of: models ask for them thousands of times."""
        out = {}
        for name, par in type(self).declared().items():
            if name in self.__dict__:
                out[name] = par.replace(self.__dict__[name])
            else:
                out[name] = par
        return out

    def nodes(self):
        """Return the wavelengths in um between which the component's spectra are straight lines."""
        return ()

    def inert(self, values):
        """Return the names of parameters of an AGN that make no difference, given the values of all."""
        return ()

    def invalid(self, values):
        """
        Say why values inside their bounds cannot be evaluated, or None.

        Used where parameters are restricted together or to a list.
        """
        return

    @property
    def refuses(self):
        """Whether `invalid` can refuse anything."""
        return type(self).invalid is not Component.invalid

    @functools.cached_property
    def path(self):
        """Path of the file of `resource`, found on first use."""
        path = locate(self.resource)
        # what is read from now on: another file may take its place later
        self.__dict__["fingerprint"] = fingerprint_of(path)
        return str(path)

    @functools.cached_property
    def fingerprint(self):
        """Checksum of the data that the component reads, "" if it reads none."""
        if not self.resource:
            return ""
        _ = self.path
        return self.__dict__["fingerprint"]

    @property
    def library(self):
        """Name of the resource that the component reads, or of itself if it reads none."""
        return self.resource or self.name

    def __repr__(self):
        values = [f"{n}={p.default:g}" for n, p in self.parameters.items()]
        values += [f"{n}={v!r}" for n, v in self.settings.items()]
        return f"{type(self).__name__}({', '.join(values)})"


def made_components(components):
    """Return components, those that are given by name with their defaults."""
    parts = []
    for component in components:
        if isinstance(component, str):
            component = named_component(component)
        wanted = "Component instances or names"
        check_that(isinstance(component, Component), "components", wanted, repr(component))
        parts.append(component)
    return parts


def in_order(components):
    """Return the components of a model in the order of their roles: what is lacking or there twice is refused."""
    if isinstance(components, (str, Mapping)):
        wanted = "a list of components or names (SEDModel.from_dict takes tables of them)"
        raise argument_error("components", wanted, type(components).__name__)
    parts = made_components(components)
    components = tuple(sorted(parts, key=lambda part: ROLES.index(part.role)))
    roles = [component.role for component in components]
    for role, name in (("sfh", "age"), ("stellar", "metallicity")):
        check_that(role in roles, "components", f"with a component of role {role!r}", roles)
        component = components[roles.index(role)]
        wanted = f"with a parameter {name!r} in the {role!r} component"
        check_that(name in component.parameters, "components", wanted, component)
    check_that(len(set(roles)) == len(roles), "components", "at most one of each role", roles)
    for role, needed_role in (("dust", "attenuation"), ("xray", "agn")):
        good = role not in roles or needed_role in roles
        check_that(good, "components", f"with {needed_role!r} if there is {role!r}", roles)
    return components


def chain_parameters(components):
    """
    Return the parameters of a model: those of its components in order, then its own.

    Raises
    ------
    ValueError
        If two components have a parameter of the same name, or one has that of the model.
    """
    parameters = {}
    for component in components:
        twice = set(component.parameters) & (set(parameters) | set(MODEL_PARAMETERS))
        check_that(not twice, "components", "without shared parameter names", sorted(twice))
        parameters.update(component.parameters)
    parameters |= MODEL_PARAMETERS
    if "dust" not in [component.role for component in components]:
        del parameters["dust_excess"]
    return parameters


def read_config(config):
    """Return the components and other options of a model from plain values; see `SEDModel.from_dict`."""
    if not isinstance(config, Mapping):
        raise config_error("[sed]", f"must be a table of keys, got {type(config).__name__}")
    sections = ["components", "frac_agn_definition"]
    if unknown := sorted(set(config).difference(sections)):
        raise config_error("[sed]", f"does not know {unknown}; known: {', '.join(sections)}")
    parts = []
    entries = config.get("components", ())
    if isinstance(entries, (str, Mapping)) or not all(isinstance(e, Mapping) for e in entries):
        msg = "[sed] components must be a list of tables with 'name', got " + repr(entries)
        raise ConfigError(msg)
    for entry in entries:
        defaults = dict(entry)
        try:
            parts.append(named_component(defaults.pop("name", "(none)"), **defaults))
        except (KeyError, TypeError, ValueError, u.UnitsError) as err:
            raise config_error("[sed]", f"component {entry}: {err.args[0]}") from err
    return parts, without(config, ["components"])
