"""What the PSFs of all instruments share: names, grids, wavelengths, the optics of JWST."""

import dataclasses

import astropy.units as u
import numpy as np

from miricigale.filters import Filter
from miricigale.psf.optics import jwst_pupil, polychromatic_psf
from miricigale.refdata import citations
from miricigale.utils.arrays import middles
from miricigale.utils.caching import cached
from miricigale.utils.units import ANGLE, WAVE, check_count, positive, scalar, to_array


@cached(maxsize=64)
def band_quantiles(name, n=9):
    """
    Return the wavelengths (um, ascending) of equal weight that stand for a band.

    The photon rate of a source of constant ``F_nu`` is cut into ``n`` equal parts; each is represented by
    its median.
    """
    band = Filter.from_name(name)
    wave = to_array(band.wave, WAVE, "wave")
    rate = np.asarray(band.throughput, dtype=float) * wave**-1.0
    total = np.concatenate([[0.0], np.cumsum(middles(rate) * np.diff(wave))])
    inside = np.concatenate([[True], np.diff(total) > 0])
    result = np.interp((np.arange(n) + 0.5) / n, total[inside] / total[-1], wave[inside])
    result.flags.writeable = False
    return result


def odd_cells(width, cell):
    """Return the odd number of cells that covers a width, nearest to it."""
    return 2 * round(0.5 * width / cell - 0.5) + 1


def checked_grid(oversampling, fov, default):
    """Return the cells per pixel and width in arcsec of a PSF's grid."""
    width = default
    if fov is not None:
        width = positive(fov, ANGLE, "fov")
    return check_count(oversampling, "oversampling"), width


@dataclasses.dataclass(frozen=True)
class Telescope:
    """
    JWST and a band: light of a point source in the focal plane.

    Attributes
    ----------
    filter : str
        Name of the band.
    angle : float
        V3IdlYAngle of the detector in deg (see `jwst_pupil`).
    wavefront_error : float
        Root mean square in nm.
    seed : int
        The same telescope in all filters.
    n_wavelengths : int
        Wavelengths of the band, of equal weight.
    n_pupil : int
        Cells across the pupil.
    """

    filter: str
    angle: float
    wavefront_error: float
    seed: int
    n_wavelengths: int = 9
    n_pupil: int = 384

    @classmethod
    def of(cls, filter, angle, wavefront_error, seed):
        """Return the telescope of the options of `~miricigale.psf.miri_psf`, checked."""
        error = scalar(wavefront_error, u.nm, "wavefront_error")
        return cls(filter, angle, error, int(seed))

    @property
    def meta(self):
        """Provenance of PSFs."""
        return {
            "wavefront_error": self.wavefront_error,
            "seed": self.seed,
            "citations": citations("psf.jwst_pupil"),
        }

    @cached(maxsize=8)
    def image(self, cell, n):
        """Return the fraction of the light in each of n x n cells of ``cell`` arcsec, read-only."""
        pupil = jwst_pupil(self.n_pupil, angle=self.angle)
        opd = pupil.wavefront_error(self.wavefront_error, seed=self.seed)
        waves = band_quantiles(self.filter, self.n_wavelengths)
        data = polychromatic_psf(pupil, opd, waves, step=cell, n=n)
        data.flags.writeable = False
        return data
