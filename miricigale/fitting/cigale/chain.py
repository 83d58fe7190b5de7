"""The chain of components that comes of modules, and a module's parameters as it reads them."""

from dataclasses import dataclass, field

import numpy as np

from miricigale.fitting.cigale.ini import parse_values
from miricigale.refdata import find_resource
from miricigale.utils.exceptions import ConfigError

__all__ = ["Chain", "Module"]

#: Parameters of CIGALE that do not change a model's spectrum here or there.
_WITHOUT_EFFECT = {
    "sfhdelayed": ("sfr_A", "normalise"),
    "sfh2exp": ("sfr_0", "normalise"),
    "sfhfromfile": ("normalise",),
    "dustatt_calzleit": ("filters",),
    "dustatt_modified_CF00": ("filters",),
    "dustatt_modified_starburst": ("filters",),
    "redshifting": ("redshift",),
}


@dataclass
class Chain:
    """
    What came of the modules.

    Parameters
    ----------
    components : list
        Components, as made.
    axes : dict of str to `~numpy.ndarray`
        Parameters that have several values.
    left_out, replaced, differs : list of str
        What there is no counterpart of; what another value or library stands in for; and
        conventions that differ.
    modules : dict of str to str
        Role to the module it came from.
    definition : str
        What the AGN fraction refers to.
    redshift : `~numpy.ndarray` or None
        Redshifts of the module ``redshifting``.
    """

    components: list = field(default_factory=list)
    axes: dict = field(default_factory=dict)
    left_out: list = field(default_factory=list)
    replaced: list = field(default_factory=list)
    differs: list = field(default_factory=list)
    modules: dict = field(default_factory=dict)
    definition: str = "dust"
    redshift: object = None


class Module:
    """One module: its parameters as text, taken one by one, and the chain it adds to."""

    def __init__(self, name, values, chain, *, folder, libraries):
        self.name, self.chain, self.folder, self.libraries = name, chain, folder, libraries
        self._values = dict(values)
        self._taken = set(_WITHOUT_EFFECT.get(name, ()))

    def label(self, key):
        return f"{self.name}.{key}"

    def numbers(self, key, default=None):
        """Values of a parameter, ascending; ``default`` where it is not in the file."""
        self._taken.add(key)
        value = self._values.get(key, "")
        if value in ("", []):
            return None if default is None else np.atleast_1d(np.asarray(default, dtype=float))
        try:
            return parse_values(value, self.label(key))
        except ValueError as err:
            raise ConfigError(str(err)) from None

    def text(self, key, default=""):
        self._taken.add(key)
        value = self._values.get(key, default)
        return value if isinstance(value, str) else ", ".join(value)

    def one(self, key, default):
        """A parameter that can have one value here: the first; others are left out."""
        values = self.numbers(key, default)
        if values.size > 1:
            others = ", ".join(f"{x:g}" for x in values[1:])
            self.chain.left_out.append(f"{self.label(key)} = {others} (one value at a time)")
        return float(values[0])

    def option(self, key, default, choices):
        """Take one value, by number, of an option."""
        number = self.one(key, default)
        if number not in choices:
            first = next(iter(choices))
            self.chain.replaced.append(f"{self.label(key)} = {number:g} by {first}")
            number = first
        return choices[number]

    def rest(self):
        """Name parameters that nobody asked for."""
        lost = [self.label(key) for key in self._values if key not in self._taken]
        self.chain.left_out.extend(lost)

    def add(self, kind, values, *, why=None, **options):
        """
        Make a component of values of its parameters, and axes where there are several.

        Values outside the bounds are left out; where none is left the nearest bound is taken.
        """
        declared = kind.declared()
        defaults = {}
        for name, (key, numbers) in values.items():
            if numbers is None:
                continue
            numbers = self._inside(declared[name], key, numbers)
            if numbers.size > 1:
                self.chain.axes[name] = numbers
            defaults[name] = float(numbers[0])
        component = kind(**defaults, **options)
        self.chain.components.append(component)
        self.chain.modules[component.role] = self.name
        if why:
            self.chain.replaced.append(f"{self.name} by {component.name}: {why}")

    def _inside(self, parameter, key, numbers):
        numbers = np.round(numbers, 12)
        low, high = parameter.bounds
        good = (numbers >= low) & (numbers <= high)
        if np.any(good):
            for value in numbers[~good]:
                self.chain.left_out.append(f"{self.label(key)} = {value:g} (not {low:g}-{high:g})")
            return numbers[good]
        value = np.clip(numbers[:1], low, high)
        text = ", ".join(f"{x:.9g}" for x in numbers)
        self.chain.replaced.append(f"{self.label(key)} = {text} by {value[0]:g}, the limit here")
        return value

    def values(self, **keys):
        """Parameter name here to key there, or to key and factor, as `add` takes them."""
        out = {}
        for name, key in keys.items():
            key, factor = key if isinstance(key, tuple) else (key, 1.0)
            numbers = self.numbers(key)
            out[name] = (key, None if numbers is None else numbers * factor)
        return out

    def choose(self, better, plain, covers):
        """The registered library if it holds the values, or what stands in for it, and why."""
        if self.libraries == "bundled":
            return plain, "the bundled tables were asked for"
        if find_resource(better.resource) is None:
            return plain, f"{better.resource} is not registered"
        why = covers(better())
        return (plain, why) if why else (better, None)
