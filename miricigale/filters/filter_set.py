"""Several filters at once."""

import dataclasses
import fnmatch
import os

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.filters.band_names import find_filter, known_filter
from miricigale.filters.filter import UNCOVERED, Filter
from miricigale.filters.filter_arguments import as_filter
from miricigale.filters.spectra import are_spectra, check_wave, spectrum_arrays
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.interactive import WithTable
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import FNU, WAVE, ab_magnitude


@dataclasses.dataclass(frozen=True)
class FilterSet(WithTable):
    """
    An ordered set of filters.

    Parameters
    ----------
    filters : iterable of `Filter` or str
        Filters, or anything else for `as_filter`, also a set of sedpy's; ``"miri.*"`` stands for all names of the
        library of this form, by wavelength.
    unit : `~astropy.units.Unit`, optional
        Unit of the wavelengths of files that name none.

    Raises
    ------
    ValueError
        If a name is there twice, or there is no filter.

    Examples
    --------
    >>> from miricigale.filters import FilterSet
    >>> filters = FilterSet.from_names(["miri.f770w", "miri.f1000w"])
    >>> filters.names
    ('miri.f770w', 'miri.f1000w')
    >>> import numpy as np
    >>> filters.weights(np.linspace(5, 15, 50)).sum(axis=1)
    array([1., 1.])
    """

    filters: tuple
    _: dataclasses.KW_ONLY
    unit: dataclasses.InitVar[object] = None

    def __post_init__(self, unit):
        items = self.filters
        single = isinstance(items, (str, os.PathLike, Filter)) or hasattr(items, "waveset")
        if single or hasattr(items, "transmission"):
            items = [items]
        # a set of sedpy's holds its filters
        items = getattr(items, "filters", items)
        members = []
        for item in items:
            members += _members(item, unit)
        filters = tuple(members)
        names = [f.name for f in filters]
        if not names or len(set(names)) < len(names):
            raise argument_error("filters", "one or more filters of different names", names)
        object.__setattr__(self, "filters", filters)

    @classmethod
    def from_names(cls, *names):
        """Make a set of filters of the library, by a list of names or several; see `Filter.from_name`."""
        return cls(names[0] if len(names) == 1 else names)

    @property
    def names(self):
        """Names, in order, as a tuple."""
        return tuple(f.name for f in self.filters)

    @property
    def pivots(self):
        """Pivot wavelengths, um, shape (n_filters,)."""
        return u.Quantity([f.pivot for f in self.filters]).to(WAVE)

    @property
    def widths(self):
        """Rectangular widths, um, shape (n_filters,)."""
        return u.Quantity([f.width for f in self.filters]).to(WAVE)

    def __len__(self):
        return len(self.filters)

    def __iter__(self):
        return iter(self.filters)

    def __contains__(self, name):
        name = getattr(name, "name", name)
        return name in self.names or (isinstance(name, str) and find_filter(name) in self.names)

    def __getitem__(self, key):
        """Return the filter of a name or number; for a slice, a list of names or numbers, or a mask, a set."""
        if isinstance(key, slice):
            return FilterSet(self.filters[key])
        is_mask = np.ndim(key) == 1 and np.asarray(key).dtype == bool
        if is_mask:
            wanted = f"of one value for each of {len(self)} filters"
            check_that(len(key) == len(self), "key", wanted, len(key))
            return FilterSet([self.filters[i] for i in np.flatnonzero(key)])
        if isinstance(key, (list, tuple, np.ndarray)):
            return FilterSet([self[name] for name in key])
        if isinstance(key, str):
            name = known_filter(key, self.names, "filter in this set")
            return self.filters[self.names.index(name)]
        return self.filters[key]

    def index(self, name):
        """Return the place of a filter, by any of its names, as that of a list."""
        return self.names.index(known_filter(name, self.names, "filter in this set"))

    def _ipython_key_completions_(self):
        """Return what a session offers in brackets: the names."""
        return list(self.names)

    def __repr__(self):
        return f"<FilterSet {', '.join(self.names)}>"

    def __add__(self, other):
        return FilterSet((*self.filters, *FilterSet(other).filters))

    def to_table(self):
        """Return the filters as a `~astropy.table.QTable`: ``name``, ``pivot`` and ``width`` (um)."""
        return _table(self.filters)

    def _repr_html_(self):
        return self.to_table()._repr_html_()

    def weights(self, wave, *, tolerance=UNCOVERED):
        """
        Return the weights of the values of a spectrum in each band.

        Parameters
        ----------
        wave : `~astropy.units.Quantity` or `~numpy.ndarray`, shape (n_wave,)
            Strictly ascending observed wavelengths; an array without unit is in um.
        tolerance : float, optional
            Share of a band that may lie outside ``wave``; 1 gives a row of zeros for a
            band that lies wholly outside.

        Returns
        -------
        weights : `~numpy.ndarray`, shape (n_filters, n_wave)
            Rows of sum 1: ``weights @ fnu`` are the photon-counting means, exact for
            F_nu linear in wavelength between the points.

        Raises
        ------
        ValueError
            If ``wave`` does not ascend or leaves more of a band uncovered.
        """
        wave = check_wave(wave)
        weights = []
        for band in self.filters:
            weights.append(band.weights(wave, tolerance=tolerance))
        return np.stack(weights)

    @takes_other_keywords
    def synthetic_fluxes(self, sed, flux=None):
        """
        Return the mean flux densities of a spectrum; see `Filter.synthetic_flux`.

        Parameters
        ----------
        sed, flux
            See `Filter.synthetic_flux`.

        Returns
        -------
        fluxes : `~astropy.units.Quantity`, shape (n_filters,); (n, n_filters) of a list of n spectra
            In uJy.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> from miricigale.filters import FilterSet
        >>> sed = SEDModel.yang2021(libraries="bundled")(redshift=1.0, mass=1e10)
        >>> FilterSet(["F160W", "F770W", "F2100W"]).synthetic_fluxes(sed).round(2)
        <Quantity [ 4.44,  7.29, 55.42] uJy>
        """
        if are_spectra(sed):
            return u.Quantity([self.synthetic_fluxes(spectrum) for spectrum in sed])
        wave, fnu = spectrum_arrays(sed if flux is None else (sed, flux), self.filters)
        return self.weights(wave) @ fnu * FNU

    @takes_other_keywords
    def synthetic_magnitudes(self, sed, flux=None):
        """Return the AB magnitudes of a spectrum, NaN where the flux is not positive; see `synthetic_fluxes`."""
        return ab_magnitude(self.synthetic_fluxes(sed, flux)) * u.ABmag

    def plot(self, ax=None, **kwargs):
        """
        Draw the throughputs, each to its peak.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where to; the current axes if not given.
        **kwargs
            Passed to `~matplotlib.axes.Axes.plot`.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`
        """
        from miricigale.plotting.curves import plot_filters

        curves = [(f.wave.value, f.throughput / f.throughput.max(), f.name) for f in self.filters]
        ax = plot_filters(curves, ax=ax, **kwargs)
        ax.set_ylabel("throughput over its peak")
        return ax


@takes_other_keywords
def filter_table(pattern=""):
    """
    Return the filters whose name holds a text, or that see a wavelength.

    Parameters
    ----------
    pattern : str or `~astropy.units.Quantity`, optional
        Part of the name or a wavelength, as for `Filter.search`; all if empty.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``name``, ``pivot`` and ``width`` (um).

    Examples
    --------
    >>> from miricigale.filters import filter_table
    >>> print(filter_table("wfc3"))
       name    pivot width
                 um    um
    ---------- ----- -----
    wfc3.f098m 0.986 0.157
    wfc3.f105w 1.055 0.265
    wfc3.f110w 1.153 0.443
    wfc3.f125w 1.249 0.285
    wfc3.f140w 1.392 0.384
    wfc3.f160w 1.537 0.268
    """
    return _table([Filter.from_name(name) for name in Filter.search(pattern)])


def _table(filters):
    widths = {key: [getattr(f, key).value for f in filters] * WAVE for key in ("pivot", "width")}
    table = QTable({"name": np.array([f.name for f in filters], dtype=str), **widths})
    table["pivot"].info.format = table["width"].info.format = ".3f"
    return table


def _members(item, unit):
    """Return the filters that an item of a set stands for."""
    if isinstance(item, str) and "*" in item:
        names = fnmatch.filter(Filter.names(), item.lower())
        if not names:
            raise unknown_name("filters like", item, Filter.names())
        members = [Filter.from_name(name) for name in names]
        return sorted(members, key=lambda member: member.pivot)
    return [as_filter(item, unit=unit)]
