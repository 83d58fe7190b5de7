"""Templates that may change as far as they are not known, fitted together with the fluxes."""

import numpy as np
import scipy.sparse

from miricigale.photometry._core.solve import factorize
from miricigale.photometry.templates.normal_equations import (
    LinearFit,
    change_matrices,
)
from miricigale.photometry.templates.pieces import divided_galaxies
from miricigale.photometry.templates.template_changes import TemplateChanges
from miricigale.utils.memory import return_freed_memory
from miricigale.utils.parallel import parallel_map
from miricigale.utils.values import value_class

#: Changes whose root of the sum of squares over the noise is below this are left out: they can move
#: no flux by more of its errors.
LEAST = 0.3


@value_class
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
        """Fluxes in uJy, shape (n,)."""
        return self.fit.flux[: self.n]

    @property
    def amplitudes(self):
        """Of the templates and of all changes, shape (n,) and (k,)."""
        amplitudes = self.basis @ self.fit.flux
        return amplitudes[: self.n], amplitudes[self.n :]

    @property
    def strain(self):
        """Chi-square of the changes of each source by their priors, shape (n,)."""
        pulls = self.fit.flux[self.n :] * np.sqrt(self.prior[self.n :])
        return np.bincount(self.owner, pulls**2, minlength=self.n)

    @property
    def xy(self):
        """Positions of the changes that are fitted, shape (m, 2)."""
        return self.bank.xy[self.basis[self.n :, self.n :].tocsc().indices]

    def remaining_power(self):
        """Return the part of each source's power that blending with its own changes leaves, shape (n,)."""
        n = self.n
        matrix = self.fit.matrix.tocoo()
        if not len(self.owner):
            return np.ones(n)
        source = np.concatenate([np.arange(n), self.owner])
        same_source = source[matrix.row] == source[matrix.col]
        entries = matrix.data[same_source], (matrix.row[same_source], matrix.col[same_source])
        blocks = scipy.sparse.coo_array(entries, shape=matrix.shape).tocsr()
        # the Schur complement of a source's changes
        side = blocks[n:, :n].sum(axis=1)
        lost = np.bincount(self.owner, side * factorize(blocks[n:, n:])(side), minlength=n)
        return 1.0 - lost / matrix.diagonal()[:n]

    def filling(self, middle):
        """
        Return the covariance that errors of templates add to the right-hand side: matrix, border and corner.

        ``middle`` is the normal matrix of the templates, (n, n).
        """
        total = scipy.sparse.diags_array(self.prior).tocsr()
        noisy = np.flatnonzero(self.noise > 0)
        if len(noisy):
            # a template whose flux is off by a factor moves the right-hand side along its column
            sides = middle.tocsc()[:, noisy] @ scipy.sparse.diags_array(
                self.flux[noisy] * np.sqrt(self.noise[noisy])
            )
            block = (sides @ sides.T).tocoo()
            n = len(self.prior)
            total = total + scipy.sparse.coo_array(
                (block.data, (block.row, block.col)), shape=(n, n)
            )
        n_common = len(self.fit.corner_rhs)
        no_border = np.zeros((len(self.prior), n_common))
        return total.tocsr(), no_border, np.zeros((n_common, n_common))

    def white_filling(self):
        """Return the covariance of the right-hand side by white noise: the priors are no noise."""
        matrix = (self.fit.matrix - scipy.sparse.diags_array(self.prior)).tocsr()
        return matrix, self.fit.border, self.fit.corner

    def change_sandwich(self, fit, correlation, images):
        """
        Sum what correlated noise does to the changes; their stamps are dropped.

        ``fit`` is that of the templates; the rest is as for
        `~miricigale.photometry.templates.normal_equations.sandwich_matrix`. Returns products of the fitted
        rows with the changes, products of the changes, and their projections.
        """
        cross, changes, change_border = change_matrices(
            fit.bank, self.bank, fit.inverse_sigma, images, correlation, last=True
        )
        return cross[fit.rows], changes, change_border

    def sandwich(self, middle, border, change_sandwich):
        """Extend the sandwich of the templates, ``middle`` and ``border``, by that of the changes."""
        cross, changes, change_border = change_sandwich
        matrix = joined_matrix(middle, cross, changes, self.basis)
        return matrix, _right_side(border, change_border, self.basis)


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
    plain_fit = fit.fit
    bank = fit.bank
    rows = fit.rows
    owner, changes, scale, noise = find_changes(fit, fitted, bank.parts(rows), bank.executor)
    if not (len(owner) or noise.any()):
        return None
    change_bank = bank.at_resolution(bank.order[rows[owner]], [change.cutout for change in changes])
    # the bank's rows are in an order of their own
    order = change_bank.order
    owner = owner[order]
    fixed = np.array([change.fixed for change in changes], bool)[order]
    light = np.array([change.light for change in changes], float)[order]
    # the bank alone has the cutouts, which it drops as it makes their templates
    del changes
    return_freed_memory()
    basis = change_basis(len(rows), owner, light, fixed)
    images = [fit.arrays.whitened(fit.arrays.flux)]
    for column in fit.columns:
        images.append(fit.arrays.whitened(column))
    cross, changes_matrix, projection = change_matrices(
        bank, change_bank, fit.inverse_sigma, images
    )
    return_freed_memory()
    cross = cross[rows]
    owner = owner[~fixed]
    # changes have unit width in units of the flux of their source
    prior = np.concatenate([np.zeros(len(rows)), scale[owner] ** -2.0])
    matrix = joined_matrix(
        plain_fit.matrix, cross, changes_matrix, basis
    ) + scipy.sparse.diags_array(prior)
    solution = LinearFit(
        matrix.tocsr(),
        _right_side(plain_fit.rhs, projection[:, 0], basis),
        _right_side(plain_fit.border, projection[:, 1:], basis),
        plain_fit.corner,
        plain_fit.corner_rhs,
    )
    return FreeTemplates(solution, change_bank, len(rows), basis, owner, prior, noise)


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
    plain_fit = fit.fit
    kernel = fit.settings.mean_kernel
    finder = TemplateChanges(kernel.source, kernel.target, fit.settings.errors.size_scatter)
    # only templates of enough signal can change by more than the noise
    snr = np.abs(plain_fit.flux) * np.sqrt(plain_fit.matrix.diagonal())
    is_known = np.isfinite(fitted["parameters"][:, 0]) & (fitted["galaxy"] == 0)
    wanted = np.flatnonzero(is_known & (snr > LEAST) & (plain_fit.flux > 0))

    def find(k):
        return finder.of(parts[k], fitted[k], LEAST / snr[k])

    results = parallel_map(find, wanted, executor=executor)
    owner = []
    changes = []
    noise = np.zeros(len(parts))
    for k, (row_changes, row_noise) in zip(wanted, results, strict=True):
        owner += [k] * len(row_changes)
        changes += row_changes
        noise[k] = row_noise
    scale = np.abs(plain_fit.flux)
    for galaxy in divided_galaxies(fitted, plain_fit.flux):
        for k in galaxy.rows:
            noise[k] = finder.pixel_noise(parts[k])
        largest = galaxy.largest
        whole_cutout = parts[largest].galaxy
        if whole_cutout is None and not galaxy.has_largest:
            # the template of the whole is that of a piece that is not fitted
            continue
        min_power = LEAST / galaxy.signal(plain_fit.matrix)
        # the whole galaxy changes, which its largest piece stands for
        scale[largest] = galaxy.flux
        for change in finder.of(whole_cutout, fitted[largest], min_power)[0]:
            owner.append(largest)
            changes.append(galaxy.of_largest(change))
    return np.array(owner, int), changes, scale, noise


def change_basis(n, owner, light, fixed):
    """
    Make the columns of a fit: templates with their fixed changes, and the changes that are fitted.

    The light of a change is taken off its template, so that the template's column has the flux of all light.

    Parameters
    ----------
    n : int
        Number of templates.
    owner : int `~numpy.ndarray`, shape (k,)
        The template of each change.
    light : `~numpy.ndarray`, shape (k,)
        Light of each.
    fixed : bool `~numpy.ndarray`, shape (k,)
        Whether it belongs to its template.

    Returns
    -------
    basis : `~scipy.sparse.csr_array`, shape (n + k, n + m)
        Of templates and all changes, for templates and the m changes that are fitted.
    """
    k = np.arange(len(owner))
    # a fixed change stands in the column of its template, others have one each
    column = np.where(fixed, owner, n + np.cumsum(~fixed) - 1)
    is_fitted = ~fixed
    rows = np.concatenate([np.arange(n), n + k, owner[is_fitted]])
    columns = np.concatenate([np.arange(n), column, column[is_fitted]])
    values = np.concatenate([np.ones(n + len(k)), -light[is_fitted]])
    shape = (n + len(k), n + int(np.count_nonzero(is_fitted)))
    return scipy.sparse.coo_array((values, (rows, columns)), shape=shape).tocsr()


def joined_matrix(main, cross, changes, basis):
    """Return the normal matrix of the columns of a basis."""
    joint = scipy.sparse.block_array([[main, cross], [cross.T, changes]]).tocsr()
    return (basis.T @ joint @ basis).tocsr()


def _right_side(main, changes, basis):
    """Return right-hand sides of the columns of a basis."""
    return basis.T @ np.concatenate([main, changes])
