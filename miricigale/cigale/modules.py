"""What the modules of CIGALE are here: components, their options, axes of a grid."""

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table

from miricigale.cigale.ini import parse_values
from miricigale.cigale.names import DECLARED, cigale_names
from miricigale.cigale.relation import N_DRAWS
from miricigale.refdata import find_resource
from miricigale.sed import components as c
from miricigale.sed.xray_bands import ALPHA_OX
from miricigale.utils.exceptions import ConfigError, config_error
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import first_value
from miricigale.utils.table_files import read_table


class Chain:
    """What came of the modules, by the names that it has in a `~miricigale.cigale.CigaleSetup`."""

    def __init__(self):
        self.components = []
        self.parameters = {}
        self.modules = {}
        self.xray = {}
        self.redshift = None
        self.frac_agn_definition = "dust"
        self.max_dev_alpha_ox = 0.0
        self.left_out = []
        self.replaced = []
        self.differs = []


class Module:
    """One module: its parameters as text, taken one by one, and the chain it adds to."""

    def __init__(self, name, values, chain, *, folder, libraries):
        self.name = name
        self.chain = chain
        self.folder = folder
        self.libraries = libraries
        old = DECLARED["old_parameters"].get(name, {})
        old = {key: new for key, new in old.items() if new not in values}
        self._values = {old.get(key, key): value for key, value in values.items()}
        self._taken = set(DECLARED["without_effect"].get(name, ()))
        self._lacking = []
        self._factors = {}

    def label(self, key):
        """Name of a parameter in messages."""
        return f"{self.name}.{key}"

    def has_key(self, key):
        """Tell whether the file has a parameter."""
        return key in self._values

    def numbers(self, key, default=None):
        """Return the values of a parameter, ascending; ``default`` where it is not in the file."""
        self._taken.add(key)
        value = self._values.get(key, "")
        if value in ("", []):
            if default is None:
                return None
            return np.atleast_1d(np.asarray(default, dtype=float))
        return parse_values(value, self.label(key))

    def text(self, key, default=""):
        self._taken.add(key)
        value = self._values.get(key, default)
        if isinstance(value, str):
            return value
        return ", ".join(value)

    def pair(self, key, default, wanted):
        """Return two numbers, of which ``wanted`` says how they are written."""
        text = self.text(key, default)
        try:
            first, second = map(float, text.replace("&", "/").split("/"))
        except ValueError:
            raise config_error(self.label(key), f"must be {wanted}, got {text!r}") from None
        return first, second

    def single(self, key, default):
        """Return a parameter that can have one value here: the first; others are left out."""
        values = self.numbers(key, default)
        if values.size > 1:
            left_out = ", ".join(f"{x:g}" for x in values[1:])
            self.chain.left_out.append(f"{self.label(key)} = {left_out} (one value at a time)")
        return float(values[0])

    def option(self, key, default, choices):
        """Take one value, by number, of an option."""
        number = self.single(key, default)
        if number not in choices:
            first = next(iter(choices))
            self.chain.replaced.append(f"{self.label(key)} = {number:g} by {first}")
        return choices.get(number, first_value(choices))

    def ignore(self, *keys):
        """Take parameters that change nothing, or that another line of the report names."""
        self._taken.update(keys)

    def report_rest(self):
        """
        Report the parameters of the module that nothing here takes, and the defaults that are taken.

        Both at once may be one parameter under another name: that is a `ConfigError`.
        """
        lost = [self.label(key) for key in self._values if key not in self._taken]
        if lost and self._lacking:
            keys = ", ".join(key for key, _ in self._lacking)
            msg = f"{', '.join(lost)}: not known here, while defaults would be taken for {keys}"
            raise ConfigError(msg)
        self.chain.left_out.extend(lost)
        if self._lacking and self._values:
            text = ", ".join(f"{key} = {value:g}" for key, value in self._lacking)
            self.chain.differs.append(f"{self.name}: not in the file, the defaults here: {text}")

    def add(self, kind, values, *, why=None, **options):
        """
        Make a component of values of its parameters, and axes where there are several.

        Values outside the bounds are left out; where none is left the nearest bound is taken.
        """
        declared = kind.declared()
        defaults = {}
        for name, (key, numbers) in values.items():
            if numbers is None:
                self._lacking.append((key, declared[name].default * self._factors.get(name, 1.0)))
                continue
            numbers = self._inside(declared[name], key, numbers)
            if numbers.size > 1:
                self.chain.parameters[name] = numbers
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

    def values(self, kind):
        """Return the values of the parameters of a component, each with its key in the file, for `add`."""
        names = cigale_names({kind.role: self.name})
        out = {}
        declared = kind.declared()
        # in the order of the names there, which is that of the axes of a grid
        for name in sorted(declared, key=(list(names) + list(declared)).index):
            theirs, _, factor = names.get(name, (name, None, 1.0))
            self._factors[name] = factor
            key = _KEYS.get(name, theirs.rpartition(".")[2])
            numbers = self.numbers(key)
            out[name] = (key, None if numbers is None else numbers / factor)
        return out

    def choose(self, better, fallback, covers):
        """Return the registered library if it holds the values, or what stands in for it, and why."""
        if self.libraries == "bundled":
            return fallback, "the bundled tables were asked for"
        if find_resource(better.resource) is None:
            return fallback, f"{better.resource} is not registered"
        why = covers(better())
        if why:
            return (fallback, why)
        return (better, None)


_IMF = {0: "Salpeter", 1: "Chabrier"}
#: Keys in the file that are not the end of the name among the results.
_KEYS = {"ebv": "E_BVs_young", "ebv_factor": "E_BVs_old_factor", "r_v_gas": "Rv"}


def _reader(kind, **options):
    """Return the reader of a module without rules of its own."""
    return lambda m: m.add(kind, m.values(kind), **options)


def _sfhfromfile(m):
    path = m.folder / m.text("filename")
    table = read_table(path, wanted="a star-formation history", cls=Table)
    rates = QTable()
    for i, name in enumerate(table.colnames):
        unit = table[name].unit or (u.Myr if i == 0 else u.Msun / u.yr)
        rates["time" if i == 0 else name] = floats(table[name]) * u.Unit(unit)
    columns = m.numbers("sfr_column", 1)
    m.chain.differs.append("sfhfromfile: one step of 1 Myr less at the same age")
    values = m.values(c.TableSFH) | {"sfh_index": ("sfr_column", columns - 1.0)}
    m.add(c.TableSFH, values, table=rates)


def _bc03(m):
    imf = _IMF.get(int(m.single("imf", 0)), "another")
    metallicity = m.numbers("metallicity", 0.02)
    numbers = {"metallicity": metallicity}
    numbers["separation_age"] = np.array([m.single("separation_age", 10.0)])
    values = {name: (name, array) for name, array in numbers.items()}

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
        m.ignore("logU", "zgas", "ne", "f_esc", "f_dust", "lines_width")
        m.chain.differs.append("nebular.emission = False: no gas at all")
        return
    values = m.values(c.Nebular)
    _, zgas = values.pop("metallicity_gas")
    stellar = _metallicity(m.chain)
    if m.numbers("ne", 100.0).tolist() != [100.0]:
        m.chain.left_out.append("nebular.ne")
    options = {"line_width": m.single("lines_width", 300.0), "gas": "stellar"}
    if zgas is not None and not np.array_equal(zgas, stellar):
        metallicities = np.unique(c.Nebular().table.metallicity)
        nearest = metallicities[np.argmin(np.abs(np.log(zgas[:, None] / metallicities)), axis=1)]
        for have, got in zip(zgas, nearest, strict=True):
            if abs(got / have - 1.0) > 1e-3:
                m.chain.replaced.append(f"nebular.zgas = {have:g} by {got:g}")
        values["metallicity_gas"] = ("zgas", np.unique(nearest))
        options["gas"] = "free"
    text = "at one logU [O II] is 4 times, [O III] 1.4 times CIGALE's"
    m.chain.differs.append(f"nebular: Cloudy tables of another make: {text}")
    m.add(c.Nebular, values, **options)


def _metallicity(chain):
    """Return the metallicities of the stars."""
    stars = [part.metallicity for part in chain.components if part.role == "stellar"]
    return chain.parameters.get("metallicity", np.array(stars))


def _modified_starburst(m):
    law = m.option("Ext_law_emission_lines", 1, {1: "mw", 2: "lmc", 3: "smc"})
    m.add(c.ModifiedStarburst, m.values(c.ModifiedStarburst), gas_law=law, ebv_scaling="cigale")


def _dale2014(m):
    if np.any(m.numbers("fracAGN", 0.0) != 0.0):
        m.chain.left_out.append("dale2014.fracAGN")
    kind, why = m.choose(c.Dale2014, c.DraineLi2007Alpha, lambda _: None)
    m.add(kind, m.values(kind), why=why)


def _dl2007(m):
    if m.numbers("umax", 1e6).tolist() != [1e6]:
        m.chain.replaced.append("dl2007.umax by 1e6")
    m.add(c.DraineLi2007, m.values(c.DraineLi2007))


def _skirtor2016(m):
    values = m.values(c.Skirtor2016)
    # since the version that has a choice of disks, grains take the place of the laws below 0.1 um
    laws = {0: "smc_wd01" if m.has_key("disk_type") else "smc", 1: "calzetti", 2: "gaskell"}
    law = m.option("law", 0, laws)
    if m.has_key("disk_type") and law in ("calzetti", "gaskell"):
        text = "continued below 0.1 um, where CIGALE has grains"
        m.chain.differs.append(f"skirtor2016.law {law}: {text}")
    # files of older versions have no choice
    disk = m.option("disk_type", 0, {0: "skirtor", 1: "schartmann2005"})
    if m.numbers("Mcl", 0.97).tolist() != [0.97]:
        m.chain.replaced.append("skirtor2016.Mcl by 0.97")
    m.chain.frac_agn_definition = _definition(m)

    def covers(library):
        wanted = {name: got for name, (_, got) in values.items() if got is not None}
        lacks = library.missing(**wanted)
        return lacks and f"the library has not all values of {', '.join(lacks)}"

    kind, why = m.choose(c.Skirtor2016, c.ParametricTorus, covers)
    m.add(kind, values, why=why, polar_law=law, disk=disk)


def _definition(m):
    low, high = m.pair("lambda_fracAGN", "0/0", "two wavelengths as 3/1000")
    if 0.1 <= low < high <= 1000.0:
        return f"{low:g}-{high:g}um"
    if (low, high) != (0.0, 0.0):
        m.chain.replaced.append(f"skirtor2016.lambda_fracAGN = {low:g}/{high:g} by 0/0")
    return "dust"


def _xray(m):
    """Options of `~miricigale.sed.with_xray_bands`; angles count since there is a parameter of them."""
    m.chain.modules["xray"] = m.name
    m.chain.xray = {
        "alpha_ox": m.numbers("alpha_ox", ALPHA_OX),
        "photon_index": m.single("gam", 1.8),
        "cutoff": m.single("E_cut", 300.0) * u.keV,
        "angle_coefficients": m.pair("angle_coef", "0 & 0", "one pair of numbers as 0.5 & 0"),
        "lmxb": m.single("det_lmxb", 0.0),
        "hmxb": m.single("det_hmxb", 0.0),
        "lmxb_index": m.single("gam_lmxb", 1.56),
        "hmxb_index": m.single("gam_hmxb", 2.0),
    }
    if not m.has_key("alpha_ox"):
        text = "not in the file, the default here: alpha_ox = -1.9 to -1.1"
        m.chain.differs.append(f"{m.name}: {text}")
    m.chain.max_dev_alpha_ox = max(m.single("max_dev_alpha_ox", 0.2), 0.0)
    if m.chain.max_dev_alpha_ox:
        text = f"by {N_DRAWS} draws of each posterior"
        m.chain.differs.append(f"{m.label('max_dev_alpha_ox')}: {text}")


def _redshifting(m):
    m.chain.redshift = m.numbers("redshift")
    m.add(c.Meiksin2006, {})


_MODULES = {
    "sfhdelayed": _reader(c.DelayedSFH),
    "sfh2exp": _reader(c.DoubleExponentialSFH),
    "sfhfromfile": _sfhfromfile,
    "bc03": _bc03,
    "nebular": _nebular,
    "dustatt_calzleit": _reader(c.CalzettiLeitherer, ebv_scaling="cigale"),
    "dustatt_modified_starburst": _modified_starburst,
    "dustatt_modified_CF00": _reader(c.CharlotFall),
    "dale2014": _dale2014,
    "casey2012": _reader(c.Casey2012),
    "dl2007": _dl2007,
    "skirtor2016": _skirtor2016,
    "xray": _xray,
    "yang20": _xray,  # its name since there is a second module of X-rays
    "redshifting": _redshifting,
}


#: Modules without which stars or the AGN would be left out, and which stand in their place.
_INSTEAD = {"m2005": "bc03 (a table is bundled)", "fritz2006": "skirtor2016 (a torus is bundled)"}


def read_modules(names, parameters, *, folder, libraries):
    """
    Take modules of CIGALE, in order, for components: a `Chain`.

    ``parameters`` are their sections in ``pcigale.ini``, ``folder`` is where files are that they name,
    and ``libraries`` (``"best"`` or ``"bundled"``) says whether registered libraries are used. A value
    that cannot be read, or a chain that is no model, is a `ConfigError`.
    """
    chain = Chain()
    for name in names:
        if name in _INSTEAD:
            raise config_error(name, f"is not here, but is needed: take {_INSTEAD[name]}")
        if name not in _MODULES:
            chain.left_out.append(name)
            continue
        values = parameters.get(name, {})
        module = Module(name, values, chain, folder=folder, libraries=libraries)
        try:
            _MODULES[name](module)
        except (ValueError, TypeError) as err:
            raise config_error("[sed_modules_params]", f"[[{name}]]: {err}") from err
        module.report_rest()
    have = {component.role for component in chain.components}
    lack = [role for role in ("sfh", "stellar") if role not in have]
    if "dust" in have and "attenuation" not in have:
        lack.append("attenuation")
    if lack:
        text = f"is known here; left out: {', '.join(chain.left_out) or 'none'}"
        raise config_error("no module", f"for {', '.join(lack)} {text}")
    return chain
