"""Pieces of a catalogue: what goes to a worker and what comes back."""

from dataclasses import dataclass, field, fields

import numpy as np

from miricigale.fitting.engines.grid import GridEngine
from miricigale.fitting.pairs import joint_names, joint_tables
from miricigale.fitting.priors import GridPriors
from miricigale.fitting.quantities import Quantities
from miricigale.utils.parallel import chunks

__all__ = ["DrawPiece", "FitPiece", "Part", "cut"]

#: Numbers of joint sums that a piece may have at once (32 MB).
_JOINT_SIZE = 1 << 22
#: Fluxes that are all 0 become negative by this part of their error; see `cut`.
_DARK = 1e-8
#: Sum of squared S/N that counts as 0: smaller numbers have fewer digits, or none.
_NO_SIGNAL = 1e-280


@dataclass(frozen=True, eq=False)
class FitPiece:
    """Fit a piece of a catalogue; picklable. Called with the keywords of `GridEngine.fit`."""

    engine: GridEngine
    priors: GridPriors
    quantities: Quantities
    pairs: tuple = ()

    def __call__(self, piece):
        joint = joint_names(self.pairs, self.priors.axes)
        if not joint:
            return self._reduce(self.engine.fit(**piece))
        # joint sums are large: those of a few objects are reduced before the next are made
        n_z, n_galaxy, _ = self.engine.galaxy.shape
        size = {"z": n_z, "g": n_galaxy, "k": self.engine.agn.shape[1], "f": self.engine.frac.size}
        n_cells = sum(size[name[0]] * size[name[1]] for name in joint)
        workspace = self.engine.workspace(joint=joint)
        n = len(piece["flux"])
        parts = []
        for rows in list(chunks(n, max(1, _JOINT_SIZE // n_cells))) or [slice(0, 0)]:
            some = {name: value[rows] for name, value in piece.items()}
            parts.append(self._reduce(self.engine.fit(**some, joint=joint, workspace=workspace)))
        return Part.merge(parts)

    def _reduce(self, out):
        """From models to parameters and derived quantities."""
        pdf = {"redshift": out.zf.sum(axis=2)}
        for name, axis in self.priors.axes.items():
            if axis.kind == "frac_agn":
                pdf[name] = out.zf.sum(axis=1)
            elif axis.kind == "galaxy":
                # not a matrix product, whose last digits depend on how many rows there are
                pdf[name] = np.einsum("ng,vg->nv", out.galaxy, axis.share)
            elif axis.kind == "agn":
                pdf[name] = np.einsum("ng,vg->nv", out.agn, axis.share)
        moments, quantiles = self.quantities.summarise(out)
        if self.engine.share_galaxy is not None:
            share = np.column_stack([out.share, np.full(len(out.share), np.nan)])
            moments = np.concatenate([moments, share[:, None]], axis=1)
            quantiles = np.concatenate([quantiles, out.share_quantiles[:, None]], axis=1)
        return Part(
            chi2=out.chi2,
            log_sum=out.log_sum,
            scale=out.best_scale,
            index=out.index,
            pdf=pdf,
            pdf_2d=out.zf,
            pairs=joint_tables(out, self.pairs, self.priors.axes),
            band=out.band,
            moments=moments,
            quantiles=quantiles,
        )


@dataclass(frozen=True, eq=False)
class DrawPiece:
    """Draw from the posteriors of a piece of a catalogue; picklable."""

    engine: GridEngine
    n_draws: int

    def __call__(self, piece):
        return self.engine.draw(n_draws=self.n_draws, **piece)


@dataclass(frozen=True, eq=False)
class Part:
    """Results of a piece of a catalogue, or of all of it."""

    chi2: np.ndarray
    log_sum: np.ndarray
    scale: np.ndarray
    index: np.ndarray
    pdf: dict = field(default_factory=dict)
    pdf_2d: np.ndarray = None
    pairs: dict = field(default_factory=dict)
    band: np.ndarray = None
    moments: np.ndarray = None
    quantiles: np.ndarray = None

    @classmethod
    def merge(cls, parts):
        """Join the pieces."""
        merged = {}
        for item in fields(cls):
            values = [getattr(part, item.name) for part in parts]
            if isinstance(values[0], dict):
                merged[item.name] = {
                    key: np.concatenate([value[key] for value in values]) for key in values[0]
                }
            else:
                merged[item.name] = np.concatenate(values)
        return cls(**merged)

    def forget(self, rows):
        """Leave nothing of these objects."""
        tables = (*self.pdf.values(), self.pdf_2d, *self.pairs.values())
        known = (self.chi2, self.log_sum, self.scale, self.band, self.moments, self.quantiles)
        for array in (*known, *tables):
            array[rows] = np.nan
        self.index[rows] = -1


def cut(data, log_prior, size, **more):
    """
    Cut a catalogue to pieces.

    Parameters
    ----------
    data : `~miricigale.fitting.likelihood.FitData`
        Photometry of n objects.
    log_prior : `~numpy.ndarray`, shape (n, nz)
        ln(prior) of the redshifts.
    size : int
        Most objects of a piece.
    **more : `~numpy.ndarray`, shape (n, ...)
        Further keywords.

    Returns
    -------
    pieces : list of dict
        Keywords of `GridEngine.fit`; one piece without objects if the catalogue has none.
    """
    with_limits = np.any(data.limit)
    out = []
    for s in list(chunks(len(data.ids), size)) or [slice(0, 0)]:
        flux, sigma, limit = np.nan_to_num(data.flux[s]), data.sigma[s], data.limit[s]
        measured = data.measured[s]
        signal = np.divide(flux, sigma, out=np.zeros(flux.shape), where=measured)
        # the engine compares directions, of which zeros have none. Just below zero the best scale
        # of every model is 0 as well, and chi2 is larger by 1e-16 a band
        dark = measured & (np.sum(signal * signal, axis=1) < _NO_SIGNAL)[:, None]
        flux = np.where(dark, -_DARK * sigma, flux)
        piece = {"flux": flux, "sigma": np.where(limit, np.inf, sigma), "log_prior": log_prior[s]}
        if with_limits:
            piece |= {"limit": flux, "limit_sigma": np.where(limit, sigma, np.inf)}
        out.append(piece | {name: value[s] for name, value in more.items()})
    return out
