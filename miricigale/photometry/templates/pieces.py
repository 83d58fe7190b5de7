"""Pieces of divided galaxies in a fit, and the changes that they have in common."""

import dataclasses

import numpy as np

from miricigale.photometry.detection.cutouts import Cutout
from miricigale.utils.values import value_class


@value_class
class Galaxy:
    """A galaxy whose pieces are sources of their own."""

    rows: np.ndarray  # (k,): Its pieces among the fitted rows.
    shares: np.ndarray  # (k,): Their parts of the light on the high-resolution image, of unit sum.
    flux: float  # Sum of their fluxes in a fit without a prior.
    lost: float  # Part of the light on the high-resolution image that is that of pieces that are not fitted.

    @property
    def largest(self):
        """The row of the largest piece."""
        return int(self.rows[np.argmax(self.shares)])

    @property
    def has_largest(self):
        """Whether no piece that is not fitted can be larger than the largest of these."""
        return self.lost < self.shares.max() * (1.0 - self.lost)

    def of_largest(self, change):
        """
        Return a change of the whole galaxy as one of its largest piece.

        Changes that are fitted have an amplitude of their own, in units of the galaxy's flux; a fixed one has that
        of the piece, which is its share of it.
        """
        if not change.fixed:
            return change
        larger = Cutout(change.cutout.data / self.shares.max(), change.cutout.origin)
        return dataclasses.replace(change, cutout=larger)

    def signal(self, matrix):
        """Return the signal-to-noise of the whole galaxy by a normal matrix."""
        # power of the sum of the pieces
        block = matrix[self.rows][:, self.rows]
        return self.flux * np.sqrt(self.shares @ (block @ self.shares))


def divided_galaxies(fitted, flux):
    """
    Find galaxies of which two pieces or more are fitted, and whose flux is positive.

    Parameters
    ----------
    fitted : `~numpy.ndarray` of `~miricigale.photometry.shapes.shapes.FITTED`, shape (n,)
        What is known of the rows.
    flux : `~numpy.ndarray`, shape (n,)
        Their fluxes.
    """
    number = fitted["galaxy"]
    share = fitted["share"]
    galaxies = []
    for galaxy in np.unique(number[number > 0]):
        rows = np.flatnonzero((number == galaxy) & (share > 0))
        total = flux[rows].sum()
        if len(rows) > 1 and total > 0:
            fitted_share = float(share[rows].sum())
            galaxies.append(
                Galaxy(rows, share[rows] / fitted_share, float(total), 1.0 - fitted_share)
            )
    return galaxies
