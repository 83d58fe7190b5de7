"""Where the posterior of objects is on the nodes of a grid: what sampling between the nodes begins with."""

from functools import cached_property

import numpy as np

from miricigale.fitting import _core
from miricigale.fitting.grid.grid import GridEngine, ObjectOnNodes, Start
from miricigale.utils.units import Frozen
from miricigale.utils.values import value_class

#: Objects that are compared with the galaxies of a redshift at once.
_TOGETHER = 4
#: Best chi2 over the number of bands above which nodes are too coarse for the errors of the data.
_EXCESS = 2.0
#: Value of a model that may not be used, and above which one may.
_NOWHERE = np.float32(-1e30)
_USABLE = np.float32(-1e29)
#: Least ln of a prior of mass below the largest one.
_LEAST_LOG = -1e4
#: Fractional part of the golden ratio, whose multiples are quasi-random.
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@value_class
class NodeScan(Frozen):
    """
    A look at all nodes of a grid in single precision, at the best AGN fraction of each pair of models.

    What is sampled between nodes afterwards has the exact posterior: draws on the nodes only say where to begin.
    `~miricigale.fitting.grid.grid.GridEngine.fit`, which sums up the posterior on the nodes itself to many digits,
    takes several times as long.

    Parameters
    ----------
    engine : `~miricigale.fitting.grid.grid.GridEngine`
        Models, priors and errors. Without a prior of rates, which has no kernel.
    n_draws : int
        Number of draws.
    """

    engine: GridEngine
    n_draws: int

    @cached_property
    def _galaxies(self):
        """`_core.ScannedGalaxies` of the grid."""
        engine = self.engine
        tables = engine.tables
        n_z, n_padded = tables.log_usable.shape
        n = engine.size["g"]
        usable = tables.log_usable > -1e200
        unit = np.ones((n_z, n_padded))
        unit[:, :n] = tables.galaxy_unit
        stars = np.zeros(n_padded)
        mass = np.zeros((n_z, 2))
        per_dex = 0.0
        if engine.density is not None:
            stars[:n] = engine.density.log_stars
            mass = engine.density.table
            per_dex = engine.density.per_dex
        dust = tables.of_galaxy[0] / unit
        most_dust = np.maximum(dust.max(axis=1), 1e-290)
        most_mass = mass.max(axis=1)
        mass = np.maximum(mass - most_mass[:, None], _LEAST_LOG)
        return _core.ScannedGalaxies(
            log_prior=np.where(usable, tables.log_usable, -1e30).astype(np.float32),
            prior=np.exp(np.where(usable, 0.5 * tables.log_usable, -np.inf)).astype(np.float32),
            log_stars=(stars - np.log10(unit)).astype(np.float32),
            dust=(dust / most_dust[:, None]).astype(np.float32),
            most_dust=most_dust,
            mass=mass.astype(np.float32),
            most_mass=most_mass,
            per_dex=per_dex,
        )

    @cached_property
    def _sums(self):
        """Ln of the sums of the priors of galaxies at each redshift."""
        return np.log(np.maximum(self._galaxies.prior.sum(axis=1, dtype=float), 1e-300))

    @cached_property
    def _uniform(self):
        return np.mod(0.5 + _GOLDEN * np.arange(self.n_draws), 1.0)

    def share(self, other):
        """Take what follows from the galaxies and their priors from another scan, with the same galaxies."""
        for name in ("_galaxies", "_sums", "_uniform"):
            self.__dict__[name] = getattr(other, name)

    def fit(self, flux, sigma, log_prior, each, nodes=None):
        """
        Scan the nodes for objects.

        Parameters
        ----------
        flux, sigma : `~numpy.ndarray`, shape (n, nb)
            Fluxes and errors in uJy; bands with infinite sigma are not used.
        log_prior : `~numpy.ndarray`, shape (n, nz)
            ln(prior) of the redshifts, -inf where it is 0; rows of -inf are not fitted.
        each : callable
            Called with an `ObjectOnNodes` of each object for which a model is possible.
        nodes : `~numpy.ndarray` of int, shape (n,), optional
            Nodes that stand for the redshifts of the objects where these are known.
        """
        data = np.where(np.isfinite(sigma), flux, 0.0)
        log_prior = np.where(np.isfinite(log_prior), 2.0 * log_prior, -1e300)
        mixture = self.engine.mixture
        broad = None if mixture is None else mixture.broad(data, sigma)
        fitted = np.flatnonzero(log_prior.max(axis=1, initial=-1e300) > -1e200)
        for first in range(0, fitted.size, _TOGETHER):
            rows = fitted[first : first + _TOGETHER]
            objects = []
            for i in rows:
                node = None if nodes is None else int(nodes[i])
                wide = None if broad is None else broad[i]
                objects.append(
                    _Scanned.of_data(self.engine, i, data[i], sigma[i], log_prior[i], wide, node)
                )
            self._fit_together(objects, each)

    def _fit_together(self, objects, each):
        """Scan the nodes for several objects at once."""
        tables = self.engine.tables
        n = len(objects)
        n_z = objects[0].target.log_prior.size
        n_padded = tables.log_usable.shape[1]
        n_bands = -(-tables.galaxy32.shape[1] // _core.TOGETHER) * _core.TOGETHER
        n_agn = tables.agn.shape[1]
        value = np.empty((n, n_z, n_padded), np.float32)
        like = np.empty((n, n_z, n_padded), np.float32)
        change = np.empty((n, n_z))
        scanned = _scanned_objects(objects, n_bands)
        work = _core.make_scan_work(n_bands, n_agn)
        _core.scan_nodes(tables, self._galaxies, scanned, work, value, like, change)
        for i, scan in enumerate(objects):
            known = self._known(scan, value[i], like[i], change[i])
            if known is not None:
                each(known)

    def _known(self, scan, value, like, change):
        """`ObjectOnNodes` of an object; None if no model is possible."""
        target = scan.target
        of_redshift = np.empty(target.log_prior.size)
        # the model of the highest likelihood
        best = np.unravel_index(np.argmax(np.where(value > _USABLE, like, _NOWHERE)), value.shape)
        pair = np.array([best], np.int64)
        index = np.empty((1, 4), np.int64)
        if not (target.norm[0] > 0.0 and value[best] > _USABLE):
            return None
        weights = np.empty(
            1 + self.engine.tables.agn.shape[1] * self.engine.tables.of_frac.shape[1]
        )
        on_best = (pair, np.full(1, -1.0), weights, index, np.empty(1))
        _core.draw_agn(self.engine.tables, target, 1.0, scan.first, *on_best)
        chi2 = self._chi2(scan, index[0])
        excess = chi2 / np.count_nonzero(scan.stated.weight[0])
        less = 0.0
        if excess > _EXCESS:
            # the posterior of data with larger errors
            less = 1.0 - 1.0 / excess
        pairs = np.empty((self.n_draws, 2), np.int64)
        _core.draw_nodes(value, like, less, of_redshift, pairs)
        index = np.empty((self.n_draws, 4), np.int64)
        log_weight = np.empty(self.n_draws)
        drawn = (pairs, self._uniform, weights, index, log_weight)
        _core.draw_agn(self.engine.tables, target, 1.0 - less, scan.first, *drawn)
        prior = 0.5 * (target.log_prior - target.level)
        log_norm = 0.0
        if self.engine.density is not None:
            # the evidence is that of a prior of redshift with the sum that it had
            rows = slice(scan.first, scan.first + len(change))
            change = change - self._sums[rows]
            log_norm = float(np.logaddexp.reduce(prior) - np.logaddexp.reduce(prior + change))
        # likelihoods of mixtures have no constant
        zero = 0.0
        if scan.wrong is None:
            zero = -0.5 * target.top
        start = Start(index, of_redshift[:, None], less > 0.0, log_weight)
        return ObjectOnNodes(scan.row, target, None, None, scan.wrong, start, log_norm, zero)

    def _chi2(self, scan, index):
        """Chi2 of a model with the stated errors."""
        z, g, k, f = index
        grid = self.engine.grid
        model = self.engine.galaxy[scan.first + z, g]
        frac = grid.frac_agn[f]
        if frac > 0:
            power = grid.dust_luminosity[g] * frac / max(1.0 - frac, 1e-12)
            model = model + power * self.engine.agn[scan.first + z, k]
        weight = scan.target.weight[z]
        scale = np.sum(weight * model * scan.target.flux)
        scale = max(scale, 0.0) / max(np.sum(weight * model * model), 1e-290)
        return np.sum(scan.stated.weight[z] * np.square(scan.stated.flux - scale * model))


@value_class
class _Scanned:
    """
    Data of an object as a scan takes them.

    ``stated`` has the stated errors, and ``target`` those of the tangents where bands may be wrong; ``wrong`` are
    then the data of the mixture. ``first`` is the first redshift of the grid.
    """

    row: int
    first: int
    stated: tuple
    target: tuple
    wrong: tuple | None

    @classmethod
    def of_data(cls, engine, row, flux, sigma, log_prior, broad, node):
        """Of fluxes, errors and 2 ln(priors of redshift), widths of broad parts, and the node of a redshift."""
        stated = _core.make_target(flux, sigma, log_prior, engine.template_error)
        target = stated
        if broad is not None:
            target, _ = engine.tangents.touch(stated, log_prior, sigma, broad)
        first = 0
        if node is not None:
            first = node
            stated = _at_node(stated, node)
            target = _at_node(target, node)
        wrong = None
        if broad is not None:
            wrong = (stated, sigma, broad)
        return cls(row, first, stated, target, wrong)


def _at_node(target, node):
    """`_core.Target` of the same data at one node of redshift."""
    rows = slice(node, node + 1)
    shift = target.level[node]
    return target._replace(
        weight=target.weight[rows],
        log_prior=target.log_prior[rows] - shift,
        root32=target.root32[rows],
        data32=target.data32[rows],
        norm=target.norm[rows],
        level=np.zeros(1),
        top=target.top - shift,
    )


def _scanned_objects(objects, n_bands):
    """`_core.ScannedObjects` of `_Scanned`, with so many bands, padded."""
    n = len(objects)
    n_z = objects[0].target.log_prior.size
    root = np.zeros((n, n_z, n_bands), np.float32)
    data = np.zeros((n, n_z, n_bands), np.float32)
    norm = np.empty((n, n_z))
    unit = np.empty((n, n_z))
    log_prior = np.empty((n, n_z))
    level = np.empty((n, n_z))
    for i, scan in enumerate(objects):
        target = scan.target
        root[i][:, target.bands] = target.root32
        data[i][:, target.bands] = target.data32
        norm[i] = target.norm
        largest = target.weight.max(axis=1)
        unit[i] = np.sqrt(target.norm / np.maximum(largest, 1e-300))
        log_prior[i] = target.log_prior - target.level
        log_prior[i][target.log_prior < -1e200] = -1e300
        level[i] = target.level
    first = np.array([scan.first for scan in objects], np.int64)
    return _core.ScannedObjects(first, root, data, norm, unit, log_prior, level)
