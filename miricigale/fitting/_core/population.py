"""Posterior of an object at places between the nodes of a grid."""

import math
from collections import namedtuple

from miricigale.fitting._core.interpolation import galaxy_light, with_agn
from miricigale.fitting._core.limits import limited_scale
from miricigale.fitting._core.nuclei import with_nuclei
from miricigale.fitting._core.structs import NO_LIGHT
from miricigale.utils._core.functions import exponential
from miricigale.utils.compilation import PART, njit

#: ln of what has no probability, and below which there is none.
NEVER = -1e300
_NONE = -1e200

#: Where places are: a unit interval for each axis (redshift, AGN fraction, those of galaxies, those of AGN), in
#: which all cells are equally wide: their number, int64 (n_axes,), lowest and highest values, (n_axes, n_largest),
#: equal where a cell is a value (the atom of a component that is absent, a label), and ln(prior) of those of AGN
#: and their fractions, (n_axes, n_largest); the galaxies of all cells, int64, flat (-1: none), of which there are
#: ``n_galaxy`` axes; and the `Light` between whose nodes models are interpolated.
Space = namedtuple("Space", "size low high log_prior cells n_galaxy light")
#: An object: `Target`, `Limits` or None, `Mixture` or None, 2 ln(prior) of galaxies, (nz, nG), `Masses`, its
#: redshift, 0 if that is free, error of AGN light as a part of it, and `Nuclei` or None.
Object = namedtuple("Object", "target limits mixture log_usable masses redshift agn_error nuclei")
#: Prior of stellar mass: ln of it, (nz, n), at log10 of masses 0, 1 / per_dex, 2 / per_dex, ...; log10 of the
#: stellar mass of each galaxy for each solar mass formed, (nG,). Without one there are two values of 0.
Masses = namedtuple("Masses", "table log_stars per_dex")
#: Bands that may be wrong, of the used ones: 1 / sigma^2 of the stated error, (nz, n_used), and of the broad
#: one, (n_used,); odds of the latter without a residual, (nz, n_used); ln of the likelihood where none is wrong
#: and there are no residuals, (nz,); memory, (4, n_used).
Mixture = namedtuple("Mixture", "narrow broad odds level rows")
# Rows of ``Mixture.rows``: fluxes of the model and of the data, 1 / sigma^2, and odds.
_MODEL, _DATA, _NARROW, _ODDS = range(4)
#: Largest number of steps to the scale with bands that may be wrong.
_STEPS = 10
#: Square of the last step over the variance of the scale.
_CLOSE = 1e-4


@njit(**PART)
def _best_scale(p, q, flux, limits):
    """
    Best scale of a model, R, variance of the scale, and chi2 of the fluxes.

    R is chi2 of no model less that of this one, and chi2 of the fluxes is less that of no model. ``p`` and ``q``
    are products of the fluxes of the model with those measured and with themselves.
    """
    if limits is not None:
        for i in range(len(limits.bands)):
            limits.slope[i] = flux[limits.bands[i]] * limits.inverse[i]
        s, r, variance = limited_scale(p, q, limits)
        return s, r, variance, s * (q * s - 2.0 * p)
    q = max(q, NO_LIGHT)
    s = max(p, 0.0) / q
    return s, s * p, 1.0 / q, -s * p


@njit(**PART)
def _widened(weight, b, flux, agn, target, agn_error):
    """Part that is left of the weight of a band with an error of the AGN's light."""
    return 1.0 / (1.0 + weight * (agn_error * agn[b] / flux[b] * target.flux[b]) ** 2)


@njit(**PART)
def _widen(flux, agn, z, target, agn_error, weight):
    """
    Weights of the bands with an error of the AGN's light: of measured fluxes, by its share of a model.

    Returned is what 2 ln(likelihood) of no light changes by.
    """
    log_change = 0.0
    for b in target.bands:
        w = target.weight[z, b]
        part = _widened(w, b, flux, agn, target, agn_error)
        weight[b] = w * part
        if part < 1.0:
            log_change += math.log(part) + (1.0 - part) * w * target.flux[b] ** 2
    return log_change


@njit(**PART)
def _likelihood(observed, limits, mixture, z, fluxes):
    """
    Best scale of a model, ln of the likelihood there but for a constant, and the variance of the scale.

    All that is known of the data is in here: ``z`` is the redshift that errors are of. With bands that may be
    wrong the scale follows from how likely each of them is, and that from the scale. ``fluxes`` are those of the
    model and of its AGN, and memory for weights; ``limits`` and ``mixture``, those of the object, are
    arguments so that kernels without them are compiled.
    """
    flux = fluxes[0]
    agn = fluxes[1]
    weight = fluxes[2]
    target = observed.target
    # without light of an AGN its error changes nothing
    agn_error = observed.agn_error
    if flux[len(flux) - 1] <= 0.0:
        agn_error = 0.0
    log_change = 0.0
    p = 0.0
    q = 0.0
    if agn_error == 0.0:
        for b in target.bands:
            wm = target.weight[z, b] * flux[b]
            p += wm * target.flux[b]
            q += wm * flux[b]
    else:
        log_change = _widen(flux, agn, z, target, agn_error, weight)
        for b in target.bands:
            wm = weight[b] * flux[b]
            p += wm * target.flux[b]
            q += wm * flux[b]
    s, r, variance, chi2 = _best_scale(p, q, flux, limits)
    log = 0.5 * (r + target.level[z] + log_change)
    if mixture is not None:
        log_errors = _used_bands(mixture, z, flux, agn, target, agn_error)
        model = mixture.rows[_MODEL]
        data = mixture.rows[_DATA]
        narrow = mixture.rows[_NARROW]
        odds = mixture.rows[_ODDS]
        product = 1.0
        for _ in range(_STEPS):
            log = mixture.level[z] + log_errors
            product = 1.0
            if limits is not None:
                log += 0.5 * (r - limits.dark + chi2)
            p = 0.0
            q = 0.0
            residual = 0.0
            for j in range(len(target.bands)):
                d = data[j] - s * model[j]
                square = d * d
                broad = mixture.broad[j]
                may_be_wrong = odds[j] > 0.0
                exponent = max(0.5 * (broad - narrow[j]) * square, -600.0)
                good = exponential(exponent) if may_be_wrong else 1.0
                residual += (broad if may_be_wrong else narrow[j]) * square
                product *= good + odds[j]
                wm = (good * narrow[j] + odds[j] * broad) / (good + odds[j]) * model[j]
                p += wm * data[j]
                q += wm * model[j]
            log -= 0.5 * residual
            before = s
            s, r, variance, chi2 = _best_scale(p, q, flux, limits)
            if (s - before) ** 2 < _CLOSE * variance:
                break
        log += math.log(product)
    return s, log, variance


@njit(**PART)
def _used_bands(mixture, z, flux, agn, target, agn_error):
    """
    Put what the likelihood takes of the used bands side by side; returned is what its ln changes by.

    That is due to the error of the AGN's light, which makes errors and odds larger.
    """
    log_errors = 0.0
    rows = mixture.rows
    for j, b in enumerate(target.bands):
        rows[_MODEL, j] = flux[b]
        rows[_DATA, j] = target.flux[b]
        rows[_NARROW, j] = mixture.narrow[z, j]
        rows[_ODDS, j] = mixture.odds[z, j]
    if agn_error > 0.0:
        for j, b in enumerate(target.bands):
            part = _widened(rows[_NARROW, j], b, flux, agn, target, agn_error)
            if part < 1.0:
                rows[_NARROW, j] *= part
                rows[_ODDS, j] /= math.sqrt(part)
                log_errors += 0.5 * math.log(part)
    return log_errors


@njit(**PART)
def _prior(observed, z, g):
    """Ln(prior) of a galaxy at a redshift, and where that stands."""
    z = 0 if observed.redshift > 0.0 else z
    if g < 0 or observed.target.log_prior[z] < _NONE or observed.log_usable[z, g] < _NONE:
        return NEVER, z
    target = observed.target
    return 0.5 * (target.log_prior[z] - target.level[z] + observed.log_usable[z, g]), z


@njit(**PART)
def _mass_prior(masses, z, g, scale):
    """Ln of the prior of the mass that a galaxy has with so many solar masses formed."""
    values = masses.table[z]
    n_last = len(values) - 2
    log_mass = math.log10(max(scale, 1.0)) + masses.log_stars[g]
    place = min(max(log_mass * masses.per_dex, 0.0), n_last + 1.0)
    k = min(int(place), n_last)
    part = place - k
    return (1.0 - part) * values[k] + part * values[k + 1]


@njit(**PART)
def _model(space, x, redshift, work):
    """
    Put fluxes of a place, and then its AGN power, into ``work.flux[0]``.

    Returned are the node of redshift and the galaxy in whose cells it is (-1: there is none), and ln(prior) but
    for theirs.
    """
    log_prior = 0.0
    g = 0
    node = 0
    for c in range(len(space.size)):
        n = space.size[c]
        y = x[c] * n
        k = min(int(y), n - 1)
        work.value[c] = space.low[c, k] + (y - k) * (space.high[c, k] - space.low[c, k])
        log_prior += space.log_prior[c, k]
        if c == 0:
            node = k
        elif 2 <= c < 2 + space.n_galaxy:
            g = g * n + k
    z_true = redshift if redshift > 0.0 else work.value[0]
    log_z = math.log1p(z_true)
    if not galaxy_light(space.light, work.value, log_z, work):
        return node, -1, log_prior
    if not with_agn(space.light, work.value, work.value[1], log_z, work):
        return node, -1, log_prior
    nearer = max(z_true, 1e-6) ** -2.0
    flux = work.flux[0]
    n_bands = len(flux) - 2
    for b in range(n_bands):
        flux[b] *= nearer
        work.flux[1, b] *= nearer
    return node, space.cells[g], log_prior


@njit(**PART)
def _likelihood_of_data(observed, nuclei, z, work):
    """As `_likelihood` of all data; ``nuclei``, those of the object, are an argument as there."""
    if nuclei is None:
        return _likelihood(observed, observed.limits, observed.mixture, z, work.flux)
    with_nuclei(nuclei, work.flux)
    return _likelihood(observed, observed.limits, observed.mixture, z, nuclei.flux)


@njit(**PART)
def _evaluate(space, observed, x, work):
    """Ln of the prior and of the likelihood of a place, its scale and the variance of that."""
    z, g, prior = _model(space, x, observed.redshift, work)
    log, z = _prior(observed, z, g)
    if log < _NONE:
        return NEVER, 0.0, 0.0, 0.0
    s, like, variance = _likelihood_of_data(observed, observed.nuclei, z, work)
    log += _mass_prior(observed.masses, z, g, s)
    return prior + log, like, s, variance
