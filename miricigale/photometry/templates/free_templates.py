"""Templates that may change as far as they are not known, fitted together with the fluxes."""

import dataclasses

import numpy as np
import scipy.sparse

from miricigale.photometry._core.solve import factorize
from miricigale.photometry.templates.normal_equations import (
    LinearFit,
    cross_matrix,
    normal_matrix,
    sandwich_matrix,
)
from miricigale.photometry.templates.pieces import divided_galaxies
from miricigale.photometry.templates.template_changes import TemplateChanges
from miricigale.utils.parallel import parallel_map

#: Changes whose root of the sum of squares over the noise is below this are left out: they can move
#: no flux by more of its errors.
LEAST = 0.3


@dataclasses.dataclass(frozen=True, eq=False)
class FreeTemplates:
    """
    Changes of templates as further columns of a fit, each with a Gaussian prior.

    A change is scaled by the flux of its source, as far as it is one standard deviation; its light is
    taken off the template, so that the fluxes stay those of all light. Fixed changes belong to the template.
    """

    fit: LinearFit  # Of the fluxes, and after them of the changes.
    bank: object  # The changes.
    n: int  # Number of fluxes.
    #: (n + k, n + m): Columns of the fit in terms of the templates and of all k changes, those
    #: that are fixed among them.
    basis: object
    owner: np.ndarray  # (m,): Source of each change that is fitted.
    prior: np.ndarray  # (n + m,): Inverse variances, zero for fluxes.
    noise: np.ndarray  # (n,): Variance of ln flux by noise in templates that are images.

    @property
    def flux(self):
        """Fluxes, shape (n,)."""
        return self.fit.flux[: self.n]

    @property
    def amplitudes(self):
        """Of the templates and of all changes, shape (n,) and (k,)."""
        found = self.basis @ self.fit.flux
        return found[: self.n], found[self.n :]

    @property
    def strain(self):
        """Chi-square of the changes of each source by their priors, shape (n,)."""
        pulls = self.fit.flux[self.n :] * np.sqrt(self.prior[self.n :])
        return np.bincount(self.owner, pulls**2, minlength=self.n)

    @property
    def xy(self):
        """Positions of the changes that are fitted, shape (m, 2)."""
        return self.bank.xy[self.basis[self.n :, self.n :].tocsc().indices]

    def alone(self):
        """What blending with its own changes leaves of each source's power, shape (n,)."""
        n, matrix = self.n, self.fit.matrix.tocoo()
        if not len(self.owner):
            return np.ones(n)
        source = np.concatenate([np.arange(n), self.owner])
        own = source[matrix.row] == source[matrix.col]
        entries = matrix.data[own], (matrix.row[own], matrix.col[own])
        blocks = scipy.sparse.coo_array(entries, shape=matrix.shape).tocsr()
        side = blocks[n:, :n].sum(axis=1)
        lost = np.bincount(self.owner, side * factorize(blocks[n:, n:])(side), minlength=n)
        return 1.0 - lost / matrix.diagonal()[:n]

    def filling(self, middle):
        """
        What the errors of the templates add to the right-hand side, (n + m, n + m).

        ``middle`` is the normal matrix of the templates, (n, n).
        """
        filling = scipy.sparse.diags_array(self.prior).tocsr()
        own = np.flatnonzero(self.noise > 0)
        if len(own):
            sides = middle.tocsc()[:, own] @ scipy.sparse.diags_array(
                self.flux[own] * np.sqrt(self.noise[own])
            )
            block = (sides @ sides.T).tocoo()
            n = len(self.prior)
            filling = filling + scipy.sparse.coo_array(
                (block.data, (block.row, block.col)), shape=(n, n)
            )
        return filling.tocsr()

    def sandwich(self, fit, correlation, middle, border, images):
        """
        Extend the sandwich of correlated noise of the templates, ``middle`` and ``border``, by the changes.

        ``fit`` is that of the templates; the rest is as for
        `~miricigale.photometry.templates.normal_equations.sandwich_matrix`.
        """
        inverse_sigma = fit.inverse_sigma
        own, more = sandwich_matrix(self.bank, inverse_sigma, correlation, images)
        cross = cross_matrix(fit.bank, self.bank, inverse_sigma, correlation).tocsr()[fit.rows]
        return joined_matrix(middle, cross, own, self.basis), _below(border, more, self.basis)


def free_templates(fit, fitted):
    """
    Fit templates anew that may change as far as they are not known.

    Parameters
    ----------
    fit : `~miricigale.photometry.fit.template_fit.TemplateFit`
        The fit of templates that are taken as they are.
    fitted : `~numpy.ndarray` of `~miricigale.photometry.shapes.shapes.FITTED`, shape (n,)
        What is known of each of its n rows that were fitted.

    Returns
    -------
    free : `FreeTemplates` or None
        None if all templates are known well enough.

    Notes
    -----
    With the template T of source k known up to changes c_j, whose amplitudes a_j have a normal
    distribution of unit width, the image is f_k T + sum_j f_k a_j (c_j - s_j T), s_j being the light
    of a change. This is linear in f_k and f_k a_j; the latter have the prior variance f_k^2, for which the
    flux of the plain fit is taken.
    """
    plain, bank, rows = fit.fit, fit.bank, fit.rows
    owner, every, scale, noise = find_changes(fit, fitted, bank.parts(rows), bank.executor)
    if not (len(owner) or noise.any()):
        return None
    other = bank.at_resolution(bank.order[rows[owner]], [one.cutout for one in every])
    owner = owner[other.order]
    fixed = np.array([one.fixed for one in every], bool)[other.order]
    basis = change_basis(
        len(rows), owner, np.array([one.light for one in every])[other.order], fixed
    )
    images = [fit.arrays.whitened(one) for one in (fit.arrays.flux, *fit.columns)]
    own, projection, _, _ = normal_matrix(other, fit.inverse_sigma, images)
    cross = cross_matrix(bank, other, fit.inverse_sigma).tocsr()[rows]
    owner = owner[~fixed]
    prior = np.concatenate([np.zeros(len(rows)), scale[owner] ** -2.0])
    matrix = joined_matrix(plain.matrix, cross, own, basis) + scipy.sparse.diags_array(prior)
    free = LinearFit(
        matrix.tocsr(),
        _below(plain.rhs, projection[:, 0], basis),
        _below(plain.border, projection[:, 1:], basis),
        plain.corner,
        plain.corner_rhs,
    )
    return FreeTemplates(free, other, len(rows), basis, owner, prior, noise)


def find_changes(fit, fitted, parts, executor):
    """
    Find how the templates of a fit can change, as far as they are not known.

    Parameters
    ----------
    fit : object
        With ``fit``, the `LinearFit` of n templates as they are, and ``settings``.
    fitted : `~numpy.ndarray` of `~miricigale.photometry.shapes.shapes.FITTED`, shape (n,)
        What is known of each.
    parts : list of `~miricigale.photometry.detection.cutouts.Cutout` or None
        The light of each, None for points.
    executor : `concurrent.futures.Executor` or None
        Threads to work with.

    Returns
    -------
    owner : int `~numpy.ndarray`, shape (k,)
        The template of each change. Changes of a divided galaxy are those of its largest piece; if that is not
        fitted there are none.
    changes : list of `~miricigale.photometry.templates.template_changes.Change`
        The k changes.
    scale : `~numpy.ndarray`, shape (n,)
        Flux (uJy) of which one standard deviation of a change is a part: that of the whole galaxy for its largest
        piece.
    noise : `~numpy.ndarray`, shape (n,)
        Variance of ln flux by noise in templates that are images.
    """
    plain = fit.fit
    kernel = fit.settings.mean_kernel
    finder = TemplateChanges(kernel.source, kernel.target, fit.settings.errors.size_scatter)
    snr = np.abs(plain.flux) * np.sqrt(plain.matrix.diagonal())
    known = np.isfinite(fitted["parameters"][:, 0]) & (fitted["galaxy"] == 0)
    wanted = np.flatnonzero(known & (snr > LEAST) & (plain.flux > 0))

    def find(k):
        return finder.of(parts[k], fitted[k], LEAST / snr[k])

    found = parallel_map(find, wanted, executor=executor)
    owner = [k for k, (some, _) in zip(wanted, found, strict=True) for _ in some]
    changes = [one for some, _ in found for one in some]
    noise = np.zeros(len(parts))
    noise[wanted] = [one for _, one in found]
    scale = np.abs(plain.flux)
    for galaxy in divided_galaxies(fitted, plain.flux):
        noise[galaxy.rows] = [finder.pixel_noise(parts[k]) for k in galaxy.rows]
        largest = galaxy.largest
        whole = parts[largest].whole
        if whole is None and not galaxy.has_largest:
            # the template of the whole is that of a piece that is not fitted
            continue
        least = LEAST / galaxy.signal(plain.matrix)
        # the whole galaxy changes, which its largest piece stands for
        scale[largest] = galaxy.flux
        for change in finder.of(whole, fitted[largest], least)[0]:
            owner.append(largest)
            changes.append(galaxy.of_largest(change))
    return np.array(owner, int), changes, scale, noise


def change_basis(n, owner, light, fixed):
    """Templates with their fixed changes, and the other changes less their light in the template."""
    k = np.arange(len(owner))
    column = np.where(fixed, owner, n + np.cumsum(~fixed) - 1)
    free = ~fixed
    rows = np.concatenate([np.arange(n), n + k, owner[free]])
    columns = np.concatenate([np.arange(n), column, column[free]])
    values = np.concatenate([np.ones(n + len(k)), -light[free]])
    shape = (n + len(k), n + int(np.count_nonzero(free)))
    return scipy.sparse.coo_array((values, (rows, columns)), shape=shape).tocsr()


def joined_matrix(main, cross, own, basis):
    """Matrix of the columns of a basis."""
    whole = scipy.sparse.block_array([[main, cross], [cross.T, own]]).tocsr()
    return (basis.T @ whole @ basis).tocsr()


def _below(main, own, basis):
    """Right-hand sides of the columns of a basis."""
    return basis.T @ np.concatenate([main, own])
