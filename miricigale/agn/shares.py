"""Shares of AGN among galaxies, measured on a sample by a hierarchical sum over posteriors."""

import numpy as np

from miricigale.utils.arrays import quotient
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.random import check_seed, stream
from miricigale.utils.units import check_count
from miricigale.utils.values import value_class

#: Pseudo-objects with and without an AGN in each bin of redshift: Jeffreys's prior of a share.
_JEFFREYS = 0.5
#: Pseudo-AGN of each bin of redshift that have the fractions common to all redshifts.
COMMON_AGN = 5.0
#: Pseudo-AGN in each bin of the fraction common to all redshifts: a flat prior.
_FLAT = 1.0
#: Pseudo-objects of the Dirichlet prior of the classes.
_CLASS_OBJECTS = 1.0
#: Draws that are left out at the beginning, over those that are kept, and at least: shares that data hardly tell
#: apart forget slowly where they began.
_BURN_IN = 0.2
_MIN_BURN_IN = 300
#: Ln of the largest ratio of evidences.
_LARGEST_RATIO = 300.0


@value_class
class ShareDraws:
    """
    Draws from the posterior of shares and numbers of AGN in a sample; made by `draw_shares`.

    Parameters
    ----------
    shares : `~numpy.ndarray`, shape (n_draws, n_z, n_frac)
        Share of each bin of the AGN fraction among the galaxies of a bin of redshift.
    counts : dict of str to `~numpy.ndarray` of int, shape (n_draws, n_z, n_frac, n_lum)
        Objects of the sample in each bin, by class.
    probability : dict of str to `~numpy.ndarray`, shape (n, n_z, n_frac, n_lum)
        Mean probability of each object to be of a class and in a bin; of the classes without bins of shape (n,).
    """

    shares: np.ndarray
    counts: dict
    probability: dict

    @property
    def n_draws(self):
        """Number of draws."""
        return len(self.shares)


def _check_table(table, prior):
    """Weights of the bins for each object, which sum to 1, and the prior of the fractions."""
    table = floats(table)
    prior = floats(prior)
    check_that(table.ndim == 4, "table", "of shape (n, n_z, n_frac, n_lum)", f"shape {table.shape}")
    wanted = f"{table.shape[2]} weights, one for each bin of the AGN fraction"
    check_that(prior.shape == table.shape[2:3], "prior", wanted, f"shape {prior.shape}")
    if not np.all(prior >= 0) or not np.isclose(prior.sum(), 1.0):
        raise argument_error("prior", "0 or more, with a sum of 1", f"{prior}")
    total = table.sum(axis=(1, 2, 3))
    if not np.all(np.isfinite(total) & (total > 0)):
        raise argument_error("table", "finite, with weight for each object", "others")
    return table / total[:, None, None, None], prior


def draw_shares(table, prior, *, others=None, n_draws=1000, seed=None):
    r"""
    Measure shares of AGN with the prior of the fits divided out.

    The posterior of each object was found with a prior :math:`\pi_j` of the bin j of the AGN fraction. With
    :math:`T_{izj}` the part of it in the bin z of redshift and j, the likelihood of shares
    :math:`\phi_{zj}` (for each z they sum to 1) is a mixture,

    .. math:: L = \prod_i \left( s_0 \sum_{zj} \frac{\phi_{zj}}{\pi_j} T_{izj} + \sum_c s_c
              \frac{Z_{ic}}{Z_{i0}} \right) ,

    with the shares s of the classes and their evidences Z, those of galaxies being s_0 and Z_0. Priors of all
    else, and that within a bin, are those of the fits. Draws are made by data augmentation: each object gets a
    class and bin by the shares, and these are drawn by the numbers of objects.

    How many AGN there are and which fractions they have are drawn apart, so that bins of the fraction add no AGN.
    The share of AGN in a bin of redshift has Jeffreys's prior, half a pseudo-object with and without an AGN. The
    fractions of these AGN have a Dirichlet prior about those of all redshifts with the weight of five objects, and
    those of all redshifts a flat one. Classes have a Dirichlet prior of one pseudo-object.

    Parameters
    ----------
    table : `~numpy.ndarray`, shape (n, n_z, n_frac, n_lum)
        Part of the posterior of each object in bins of redshift, AGN fraction and luminosity, of fits as a galaxy.
        The first fraction is that of no AGN.
    prior : `~numpy.ndarray`, shape (n_frac,)
        Prior of the fractions in these fits.
    others : dict of str to tuple, optional
        Other classes: ln of the evidence over that of a galaxy, shape (n,), NaN where it is not known, and the
        table of the fits as that class, or None.
    n_draws : int, optional
        Number of draws.
    seed : int or `~numpy.random.Generator`, optional
        Seed of the draws.

    Returns
    -------
    draws : `ShareDraws`
        With the class ``galaxy`` and those of ``others``.

    Raises
    ------
    ValueError
        If shapes do not agree, an object has no weight, or the prior is none.

    References
    ----------
    Hogg, Myers & Bovy 2010, ApJ 725, 2166. Diebolt & Robert 1994, JRSS B 56, 363 (draws of mixtures). Teh et al.
    2006, JASA 101, 1566 (draws of shares common to several groups).

    Examples
    --------
    Half of 200 objects are sure to have an AGN, though the prior has it in one of ten:

    >>> import numpy as np
    >>> from miricigale.agn import draw_shares
    >>> table = np.zeros((200, 1, 2, 1))
    >>> table[:100, 0, 0] = table[100:, 0, 1] = 1.0
    >>> draws = draw_shares(table, [0.9, 0.1], seed=1)
    >>> draws.shares[:, 0, 1].mean().round(1)
    np.float64(0.5)
    """
    table, prior = _check_table(table, prior)
    n_draws = check_count(n_draws, "n_draws")
    rng = stream(check_seed(seed), "agn", "shares")
    n, n_z, n_frac, _ = table.shape
    classes = _other_classes(others, n)
    ratio = np.zeros((n, len(classes)))
    for k, (class_ratio, _) in enumerate(classes.values()):
        ratio[:, k] = class_ratio
    divided = np.divide(
        table.sum(axis=3), prior, out=np.zeros((n, n_z, n_frac)), where=prior > 0
    ).reshape(n, -1)
    allowed = prior > 0
    shares = np.tile(allowed / allowed.sum(), (n_z, 1))
    common = _dirichlet(rng, np.where(allowed[1:], _FLAT, 0.0))
    class_shares = np.full(1 + ratio.shape[1], 1.0 / (1 + ratio.shape[1]))
    kept_shares = np.empty((n_draws, n_z, n_frac))
    counts = {}
    for name in ["galaxy"] + list(classes):
        counts[name] = np.zeros((n_draws,) + table.shape[1:], int)
    probability = np.zeros((n, divided.shape[1] + ratio.shape[1]))
    n_burn = max(int(np.ceil(_BURN_IN * n_draws)), _MIN_BURN_IN)
    for turn in range(-n_burn, n_draws):
        of_galaxy = class_shares[0] * divided * shares.ravel()
        weight = np.concatenate([of_galaxy, class_shares[1:] * ratio], axis=1)
        cumulative = np.cumsum(weight, axis=1)
        drawn = rng.random(n) * cumulative[:, -1]
        component = np.sum(cumulative <= drawn[:, None], axis=1)
        component = np.minimum(component, weight.shape[1] - 1)
        number = np.bincount(component, minlength=weight.shape[1])
        of_bins = number[: n_z * n_frac].reshape(n_z, n_frac)
        common = _draw_common(rng, of_bins[:, 1:], common, allowed[1:])
        shares = _draw_by_redshift(rng, of_bins, common, allowed)
        of_classes = np.concatenate([[of_bins.sum()], number[n_z * n_frac :]])
        class_shares = _dirichlet(rng, of_classes + _CLASS_OBJECTS / of_classes.size)
        if turn < 0:
            continue
        kept_shares[turn] = shares
        probability += weight / cumulative[:, -1:]
        luminosity = rng.random(n)
        counts["galaxy"][turn] = _galaxy_counts(table, component, luminosity)
        for k, (name, (_, class_table)) in enumerate(classes.items()):
            if class_table is not None:
                members = np.flatnonzero(component == n_z * n_frac + k)
                counts[name][turn] = _member_counts(class_table, members, luminosity)
    probability /= n_draws
    by_class = {"galaxy": _by_luminosity(table, probability[:, : n_z * n_frac])}
    for k, name in enumerate(classes):
        by_class[name] = probability[:, n_z * n_frac + k]
    return ShareDraws(kept_shares, counts, by_class)


def _other_classes(posteriors, n):
    """Ratios of evidences, at most a large number, and tables of other classes that were fitted: dict by name."""
    classes = {}
    for name, (log_ratio, table) in (posteriors or {}).items():
        log_ratio = np.asarray(log_ratio, float)
        check_that(log_ratio.shape == (n,), "others", f"{n} ratios of {name}", f"{log_ratio.shape}")
        ratio = np.exp(
            np.minimum(np.where(np.isnan(log_ratio), -np.inf, log_ratio), _LARGEST_RATIO)
        )
        classes[name] = ratio, table
    return classes


def _dirichlet(rng, numbers):
    """Draw shares that sum to 1 along the last axis; a bin without any pseudo-object has none."""
    drawn = np.where(numbers > 0, rng.standard_gamma(np.maximum(numbers, 1e-300)), 0.0)
    # of tiny numbers all may be 0
    drawn = np.maximum(drawn, np.where(numbers > 0, 1e-300, 0.0))
    total = drawn.sum(axis=-1, keepdims=True)
    return np.divide(drawn, total, out=drawn, where=total > 0)


def _draw_common(rng, numbers, common, allowed):
    """
    Draw the shares of AGN fractions common to all redshifts.

    Of the AGN of a bin, ``numbers`` (n_z, n_agn), only so many count as are new in the sequence in which one after
    the other is like an earlier one of its redshift, or is drawn from the common shares (Antoniak 1974).
    """
    weight = COMMON_AGN * common
    earlier = np.arange(numbers.max(initial=0))
    probability = np.ones((common.size, earlier.size))
    np.divide(weight[:, None], weight[:, None] + earlier, out=probability, where=earlier > 0)
    is_new = rng.random(numbers.shape + earlier.shape) < probability
    n_new = np.sum(is_new & (earlier < numbers[..., None]), axis=(0, 2))
    return _dirichlet(rng, np.where(allowed, n_new + _FLAT, 0.0))


def _draw_by_redshift(rng, numbers, common, allowed):
    """Draw the shares of each bin of redshift by its objects, (n_z, n_frac): of AGN, and of their fractions."""
    n_agn = numbers[:, 1:].sum(axis=1)
    pseudo = np.where([np.any(allowed[1:]), allowed[0]], _JEFFREYS, 0.0)
    of_agn = _dirichlet(rng, np.stack([n_agn, numbers[:, 0]], axis=1) + pseudo)
    fractions = _dirichlet(rng, numbers[:, 1:] + COMMON_AGN * common)
    return np.concatenate([of_agn[:, 1:], of_agn[:, :1] * fractions], axis=1)


def _draw_places(part, uniform):
    """Draw a column for each row of weights, (m, n_columns), by uniform numbers: (m,)."""
    cumulative = np.cumsum(part, axis=1)
    place = np.sum(cumulative <= (uniform * cumulative[:, -1])[:, None], axis=1)
    # rounding may lift a number to the end
    return np.minimum(place, part.shape[1] - 1)


def _galaxy_counts(table, component, uniform):
    """Galaxies in the bins, (n_z, n_frac, n_lum): those of redshift and fraction are drawn, flat, or too large."""
    n, n_z, n_frac, n_lum = table.shape
    rows = np.flatnonzero(component < n_z * n_frac)
    weights = table.reshape(n, n_z * n_frac, n_lum)[rows, component[rows]]
    flat = component[rows] * n_lum + _draw_places(weights, uniform[rows])
    return np.bincount(flat, minlength=n_z * n_frac * n_lum).reshape(table.shape[1:])


def _member_counts(table, members, uniform):
    """Members of another class in the bins, which are drawn from their own posteriors."""
    weights = table[members].reshape(len(members), np.prod(table.shape[1:]))
    flat = _draw_places(weights, uniform[members])
    return np.bincount(flat, minlength=weights.shape[1]).reshape(table.shape[1:])


def _by_luminosity(table, probability):
    """Probabilities of bins of redshift and fraction, (n, n_z * n_frac), in those of luminosity too."""
    total = table.sum(axis=3, keepdims=True)
    part = quotient(table, total)
    return probability.reshape(total.shape) * part
