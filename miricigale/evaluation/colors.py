"""Classes from colors of MIRI bands, to be compared with those of the fits."""

import dataclasses
import itertools

import numpy as np
from astropy.table import vstack

from miricigale.evaluation.classes import CLASS_NAMES, KIRKPATRICK_LIMITS, classify
from miricigale.evaluation.estimates import Estimate
from miricigale.utils.exceptions import argument_error
from miricigale.utils.random import check_seed, stream
from miricigale.utils.units import FNU, to_array

#: Distances from a center that are tried as radii, and places along each color that are tried as centers.
_N_RADII, _N_CENTERS = 40, 17


@dataclasses.dataclass(frozen=True)
class ColorWindow:
    """
    Two colors that separate AGN from galaxies in a range of redshifts.

    Parameters
    ----------
    z_low, z_high : float
        The redshifts.
    x, y : tuple of str
        Bands of the two colors: log10 of the flux ratio of the first to the second.

    Examples
    --------
    >>> from miricigale.evaluation import COLOR_WINDOWS
    >>> window = COLOR_WINDOWS[0]
    >>> window.z_low, window.z_high
    (0.75, 1.25)
    >>> window.bands
    ('miri.f1000w', 'miri.f770w', 'miri.f1500w', 'miri.f1800w')
    """

    z_low: float
    z_high: float
    x: tuple
    y: tuple

    @property
    def bands(self):
        """Names of the bands, each once."""
        return tuple(dict.fromkeys([*self.x, *self.y]))

    def colors(self, fluxes):
        """Colors of a table of fluxes, shape (n, 2); NaN where a flux is not positive."""
        values = {name: to_array(fluxes[name], FNU, name) for name in self.bands}
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = {name: np.log10(np.where(v > 0, v, np.nan)) for name, v in values.items()}
        return np.stack([logs[a] - logs[b] for a, b in (self.x, self.y)], axis=-1)


#: After Kirkpatrick et al. 2017, ApJ 849, 111: the slope from starlight to hot dust, and a band with a PAH
#: feature over a neighboring one. Redshifts and bands of the first are theirs
#: (https://kirkpatrick.ku.edu/JWST, which has the colors as pictures); of the three ways to pair them
#: this one, chosen for it, comes nearest to the shares that theirs find. Both of the others are ours in
#: the same spirit.
COLOR_WINDOWS = (
    ColorWindow(0.75, 1.25, ("miri.f1000w", "miri.f770w"), ("miri.f1500w", "miri.f1800w")),
    ColorWindow(1.25, 1.75, ("miri.f1280w", "miri.f770w"), ("miri.f1800w", "miri.f2100w")),
    ColorWindow(1.75, 2.25, ("miri.f1280w", "miri.f1000w"), ("miri.f1800w", "miri.f2100w")),
)


@dataclasses.dataclass(frozen=True)
class ColorCircles:
    """
    Regions of a plane of two colors between circles: AGN inside, composites around, galaxies outside.

    The shape is that of Kirkpatrick et al. 2017; `fit` takes center and radii from sources of known class,
    since their numbers belong to their templates.

    Parameters
    ----------
    center : tuple of float
        Colors of the center.
    inner, outer : float
        Radii in dex.

    Examples
    --------
    >>> from miricigale.evaluation import ColorCircles
    >>> circles = ColorCircles(center=(0.3, 0.0), inner=0.1, outer=0.3)
    >>> print(circles.classify([[0.3, 0.05], [0.1, 0.0], [-0.4, 0.2]]))
    ['agn' 'composite' 'galaxy']
    """

    center: tuple
    inner: float
    outer: float

    @classmethod
    def fit(cls, colors, classes):
        """
        Circles that separate sources of known class best.

        Parameters
        ----------
        colors : array-like, shape (n, 2)
            Colors; rows with NaN are left out.
        classes : array-like of str, shape (n,)
            Names of `~miricigale.evaluation.CLASS_NAMES`.

        Returns
        -------
        circles : `ColorCircles`
            With the center and radii of the highest mean of the shares of each class that are found in it.
            Centers are tried from the median color of the AGN to half a range of the colors beyond all:
            AGN with silicate absorption do not lie around their median.

        Raises
        ------
        ValueError
            If there is no AGN with colors.
        """
        colors, classes = np.asarray(colors, float), np.asarray(classes, str)
        good = np.isfinite(colors).all(axis=1)
        colors, classes = colors[good], classes[good]
        agn = classes == CLASS_NAMES[2]
        if not agn.any():
            raise argument_error("classes", "with an AGN that has colors", "none")
        low, high = np.percentile(colors, [2, 98], axis=0)
        reach = 0.5 * (high - low)
        places = np.linspace(low - reach, high + reach, _N_CENTERS)
        centers = [np.median(colors[agn], axis=0), *itertools.product(*places.T)]
        best = -np.inf
        for center in centers:
            score, radii = _best_radii(np.hypot(*(colors - center).T), classes)
            # of equal ones the first
            if score > best + 1e-12:
                best, found = score, (tuple(float(x) for x in center), *radii)
        return cls(*found)

    def classify(self, colors):
        """Class of each row of colors, shape (n, 2); ``"unknown"`` for those with NaN."""
        colors = np.asarray(colors, float)
        distance = np.hypot(*(colors - np.array(self.center)).T)
        # from the outside inwards
        index = np.where(distance <= self.inner, 2, np.where(distance <= self.outer, 1, 0))
        names = np.array([*CLASS_NAMES, "unknown"])
        return names[np.where(np.isfinite(distance), index, 3)]


def _best_radii(distance, classes):
    """Highest sum of the shares of each class found within its radii about a center, and the radii."""
    tried = np.unique(np.quantile(distance, np.linspace(0, 1, _N_RADII)))
    # between sources, and one beyond all
    steps = np.append(0.5 * (tried[1:] + tried[:-1]), tried[-1])
    # share of each class within each radius
    within = {
        name: np.searchsorted(np.sort(distance[classes == name]), steps, side="right")
        / np.count_nonzero(classes == name)
        for name in CLASS_NAMES
        if np.any(classes == name)
    }
    galaxy, composite, inside = (within.get(name, np.zeros(steps.size)) for name in CLASS_NAMES)
    score = inside[:, None] + composite - composite[:, None]
    score += 1 - galaxy if CLASS_NAMES[0] in within else 0
    score[np.tril_indices(steps.size, -1)] = -np.inf
    i, j = np.unravel_index(np.argmax(score), score.shape)
    return score[i, j], (float(steps[i]), float(steps[j]))


def color_classes(fluxes, redshift, classes, *, windows=COLOR_WINDOWS, groups=None, seed):
    """
    Classes of sources by their colors: each half of them by circles fitted to the other half.

    Parameters
    ----------
    fluxes : `~astropy.table.QTable`
        Fluxes of the bands of the windows.
    redshift : array-like, shape (n,)
        Redshifts by which a source is in a window.
    classes : array-like of str, shape (n,)
        True classes, to which the circles are fitted.
    windows : iterable of `ColorWindow`, optional
        Colors by redshift.
    groups : array-like, shape (n,), optional
        Rows of one value stay in one half, such as one galaxy with several AGN; ids of the sources.
    seed : int
        Seed of the division.

    Returns
    -------
    found : `~numpy.ndarray` of str, shape (n,)
        ``"unknown"`` for sources in no window or without positive fluxes.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.table import QTable
    >>> from miricigale.evaluation import COLOR_WINDOWS, color_classes
    >>> rng = np.random.default_rng(1)
    >>> classes = np.repeat(["galaxy", "agn"], 100)
    >>> fluxes = QTable({b: rng.lognormal(0, 0.05, 200) for b in COLOR_WINDOWS[0].bands})
    >>> fluxes["miri.f1000w"][100:] *= 3
    >>> fluxes = QTable({b: fluxes[b] * u.uJy for b in fluxes.colnames})
    >>> first = COLOR_WINDOWS[:1]
    >>> found = color_classes(fluxes, np.ones(200), classes, windows=first, seed=1)
    >>> print(f"{np.mean(found == classes):.2f}")
    1.00
    """
    redshift, classes = np.asarray(redshift, float), np.asarray(classes, str)
    found = np.full(redshift.size, "unknown", dtype="<U9")
    groups = np.arange(redshift.size) if groups is None else np.asarray(groups)
    names, index = np.unique(groups, return_inverse=True)
    half = (stream(check_seed(seed), "colors").permutation(names.size) % 2)[index]
    for window in windows:
        rows = (redshift >= window.z_low) & (redshift < window.z_high)
        colors = window.colors(fluxes)
        known = rows & np.isfinite(colors).all(axis=1)
        for k in range(2):
            others, own = known & (half != k), rows & (half == k)
            if np.any(classes[others] == CLASS_NAMES[2]) and own.any():
                found[own] = ColorCircles.fit(colors[others], classes[others]).classify(colors[own])
    return found


def color_estimates(study, mid_infrared, *, seed):
    """
    Shares of galaxies, composites and AGN that are found by colors, of all truths of a study together.

    Parameters
    ----------
    study : `~miricigale.evaluation.StudyResults`
        The tables, with the bands of `COLOR_WINDOWS`; redshifts of the fit ``"all"`` choose the colors.
    mid_infrared : dict of str to array-like, shape (n,)
        True AGN shares of the 5-15 um light of all sources (`mid_infrared_fractions`) by name of the truth;
        others are left out.
    seed : int
        Of the division into halves.

    Returns
    -------
    estimates : dict of str to `~miricigale.evaluation.Estimate`
        ``"colors.<class>"``, for ``extra`` of the study: of the fitted sources with colors, ``n_all`` those
        without too.
    """
    bands = tuple(dict.fromkeys(band for window in COLOR_WINDOWS for band in window.bands))
    tables, redshift, share = [], [], []
    for one in study.truths:
        if one.name in mid_infrared and "all" in one.fits:
            tables.append(one.matched["id", *bands][one.sample])
            redshift.append(one.fitted("all", "redshift_mean"))
            share.append(np.asarray(mid_infrared[one.name], float)[one.sample])
    if not tables:
        return {}
    fluxes = vstack(tables, metadata_conflicts="silent")
    true = classify(np.concatenate(share), limits=KIRKPATRICK_LIMITS)
    found = color_classes(fluxes, np.concatenate(redshift), true, groups=fluxes["id"], seed=seed)
    seen = found != "unknown"
    return {
        f"colors.{name}": Estimate.of_fraction(
            np.count_nonzero((true == name) & (found == name)),
            np.count_nonzero((true == name) & seen),
            n_all=int(np.count_nonzero(true == name)),
        )
        for name in CLASS_NAMES
    }
