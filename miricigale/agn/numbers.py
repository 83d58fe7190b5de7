"""Tables of a survey of AGN: numbers by redshift and luminosity, totals, and the prior of the AGN fraction."""

import astropy.units as u
import numpy as np

from miricigale.evaluation import Estimate
from miricigale.evaluation.classes import CLASS_LIMITS
from miricigale.sed.spectrum import COSMOLOGY
from miricigale.utils.arrays import nans
from miricigale.utils.package_tables import column_texts
from miricigale.utils.random import stream
from miricigale.utils.tables import described_rows
from miricigale.utils.values import value_class

#: AGN fraction from which AGN are counted by luminosity: smaller ones look like none.
FLOOR = CLASS_LIMITS[0]
#: Percentiles of intervals.
_INTERVAL = (15.865, 84.135)
#: Pseudo-counts of the prior of a rate: Jeffreys's, of a Poisson distribution.
_JEFFREYS = 0.5
#: Smallest share of the injected AGN of a bin that must have a fraction of `FLOOR` or more: with fewer, the
#: density of the bin is mostly an extrapolation.
MIN_ABOVE = 0.5
#: Smallest share of the injected AGN with a fraction from the limit on that must be selected: with fewer, the
#: number of the bin is a sum of small probabilities, which go by the prior.
MIN_SELECTED = 0.1


def _texts(name):
    return column_texts("miricigale.agn", name)


def _summary(draws, name):
    """Median and 68 % interval of draws, by name."""
    if not np.all(np.isfinite(draws)):
        return dict.fromkeys((name, f"{name}_low", f"{name}_high"), np.nan)
    low, high = np.percentile(draws, _INTERVAL)
    return {name: float(np.median(draws)), f"{name}_low": float(low), f"{name}_high": float(high)}


@value_class
class SampleNumbers:
    """
    What the numbers of a survey are made of.

    Parameters
    ----------
    bins : `~miricigale.fitting.AGNBins`
        The bins.
    limit, floor : float
        AGN fractions from which an object is selected, and from which AGN are counted by luminosity.
    draws : `~miricigale.agn.ShareDraws`
        Shares and numbers by the measured prior.
    shipped : dict of str to `~numpy.ndarray`, shape (n_z, n_frac, n_lum)
        Sums of the posteriors as they were fitted, by class.
    area : float
        Area in square degrees.
    n_all, n_used : int
        Objects of the catalog, and those whose posteriors are in the sums.
    selected : `~numpy.ndarray`, shape (n_z, n_lum)
        Selected objects by fitted redshift and luminosity.
    pure : `~numpy.ndarray`, shape (n_z, n_lum)
        Sum of their probabilities to have an AGN fraction of at least the limit, by the measured prior.
    pure_shipped : `~numpy.ndarray`, shape (n_z, n_lum)
        The same by the prior of the fits.
    injected : dict of str to `~numpy.ndarray` of int, shape (n_z, n_lum)
        Injected AGN by true redshift and luminosity: ``all``; ``above`` the floor; above the ``limit``; the
        ``selected`` ones; and of these the ``right`` ones, above the limit.
    seed : int
        Of the errors of rates.
    """

    bins: object
    limit: float
    floor: float
    draws: object
    shipped: dict
    area: float
    n_all: int
    n_used: int
    selected: np.ndarray
    pure: np.ndarray
    pure_shipped: np.ndarray
    injected: dict
    seed: int

    def volume(self, i):
        """Comoving volume of a bin of redshift in Mpc3."""
        z_low, z_high = self._edges(i)
        low = COSMOLOGY.comoving_volume(z_low).to_value(u.Mpc**3)
        high = COSMOLOGY.comoving_volume(z_high).to_value(u.Mpc**3)
        return (high - low) * self.area / (4.0 * np.pi * u.sr).to_value(u.deg**2)

    def _edges(self, i):
        return self.bins.redshift[i], self.bins.redshift[i + 1]

    def _luminosity_edges(self):
        """Edges of the bins of log10 of the luminosity, the last of which is open."""
        return tuple(self.bins.log_luminosity) + (np.inf,)

    def by_luminosity(self):
        """
        Numbers of AGN by redshift and luminosity.

        Returns
        -------
        table : `~astropy.table.QTable`
            A row for each bin; the last of the luminosity has no upper end, and so no density.
        """
        rows = []
        n_z = len(self.bins.redshift) - 1
        for i in range(n_z):
            for k in range(1, self.bins.shape[2]):
                rows.append(self._row(i, k))
        table = described_rows(rows, _texts("numbers"))
        for name in ("density", "density_low", "density_high", "density_shipped"):
            table[name].unit = 1 / u.Mpc**3 / u.dex
        return table

    def _first(self, fraction):
        """First bin of the AGN fraction from one of its edges on."""
        return self.bins.frac_agn.index(fraction) + 1

    def _row(self, i, k):
        edges = self._luminosity_edges()
        low = edges[k - 1]
        high = edges[k]
        z_low, z_high = self._edges(i)
        row = {"redshift_low": z_low, "redshift_high": z_high}
        row |= {"log_luminosity_low": low, "log_luminosity_high": high}
        first = self._first(self.floor)
        by_class = {}
        for name, counts in self.draws.counts.items():
            by_class[name] = counts[:, i, first:, k].sum(axis=1)
        number = sum(by_class.values())
        row |= _summary(number, "n")
        n_shipped = 0.0
        for shipped in self.shipped.values():
            n_shipped += shipped[i, first:, k].sum()
        row["n_shipped"] = float(n_shipped)
        injected = {name: int(counts[i, k]) for name, counts in self.injected.items()}
        row["n_injected"] = injected["all"]
        for name, kind in (("completeness", "selected"), ("above", "above")):
            share = Estimate.of_fraction(injected[kind], injected["all"])
            row |= {name: share.value, f"{name}_low": share.low, f"{name}_high": share.high}
        n_selected = self.selected[i, k]
        row["n_selected"] = int(n_selected)
        row["purity"] = np.nan
        row["purity_shipped"] = np.nan
        if n_selected:
            row["purity"] = self.pure[i, k] / n_selected
            row["purity_shipped"] = self.pure_shipped[i, k] / n_selected
        row |= _summary(self._corrected(i, k, "all"), "n_corrected")
        n_visible = injected["limit"]
        are_selected = not n_visible or injected["right"] >= MIN_SELECTED * n_visible
        row["constrained"] = bool(row["above"] >= MIN_ABOVE and are_selected)
        row |= self._density(number, row["n_shipped"], injected, i, k)
        return row | self._obscured(by_class, i, k)

    def _corrected(self, i, k, kind):
        """
        Draws of the number of AGN of a bin by the selected ones and the injected ones of a kind.

        NaN where AGN are selected, and no such injected one is.
        """
        pure = self.pure[i, k]
        rng = stream(self.seed, "agn", "corrected", i, k)
        share = self._selected_share(rng, self.injected["right"][i, k], self.injected[kind][i, k])
        if pure > 0:
            return rng.standard_gamma(pure, self.draws.n_draws) / share
        return 0.0 * share

    def _selected_share(self, rng, n_right, n_injected):
        """Draws of the share of injected AGN that is selected; NaN where none is."""
        if not n_right:
            return nans(self.draws.n_draws)
        n_lost = n_injected - n_right
        return rng.beta(n_right + _JEFFREYS, n_lost + _JEFFREYS, self.draws.n_draws)

    def _density(self, number, n_shipped, injected, i, k):
        """Calculate the density of all AGN of a bin, corrected for those with a fraction below the floor."""
        width = np.diff(self._luminosity_edges())[k - 1]
        if not injected["all"] or not injected["above"] or np.isinf(width):
            return _summary(nans(1), "density") | {"density_shipped": np.nan}
        rng = stream(self.seed, "agn", "rates", i, k)
        # of a field of this size others have more or fewer, and objects without a fit are like the rest
        per_object = self.n_all / self.n_used / (self.volume(i) * width)
        n_below = injected["all"] - injected["above"]
        above = rng.beta(injected["above"] + _JEFFREYS, n_below + _JEFFREYS, number.size)
        rate = rng.standard_gamma(number + _JEFFREYS) * per_object / above
        shipped = n_shipped * per_object * injected["all"] / injected["above"]
        return _summary(rate, "density") | {"density_shipped": shipped}

    def _obscured(self, by_class, i, k):
        """Share of the AGN that is obscured: those in fits as a galaxy, whose torus hides the disk."""
        if "quasar" not in by_class:
            return _summary(nans(1), "obscured") | {"obscured_shipped": np.nan}
        rng = stream(self.seed, "agn", "obscured", i, k)
        hidden = rng.standard_gamma(by_class["galaxy"] + _JEFFREYS)
        unobscured = rng.standard_gamma(by_class["quasar"] + _JEFFREYS)
        first = self._first(self.floor)
        by_posterior = {}
        for name in ("galaxy", "quasar"):
            by_posterior[name] = self.shipped[name][i, first:, k].sum()
        total = by_posterior["galaxy"] + by_posterior["quasar"]
        shipped = np.nan
        if total > 0:
            shipped = float(by_posterior["galaxy"] / total)
        return _summary(hidden / (hidden + unobscured), "obscured") | {"obscured_shipped": shipped}

    def totals(self):
        """
        Numbers of all AGN from the floor of the AGN fraction on, and from the limit of selected ones on.

        Returns
        -------
        table : `~astropy.table.QTable`
            A row for each of the two.
        """
        n_z = len(self.bins.redshift) - 1
        rows = []
        for fraction in sorted({self.floor, self.limit}):
            first = self._first(fraction)
            number = 0
            for counts in self.draws.counts.values():
                number = number + counts[:, :n_z, first:].sum(axis=(1, 2, 3))
            row = {"frac_agn": fraction} | _summary(number, "n")
            n_shipped = 0.0
            for weights in self.shipped.values():
                n_shipped += weights[:n_z, first:].sum()
            row["n_shipped"] = float(n_shipped)
            row["n_selected"] = int(self.selected[:n_z].sum())
            row |= _summary(self._total_corrected(fraction), "n_corrected")
            rows.append(row)
        return described_rows(rows, _texts("totals"))

    def _total_corrected(self, fraction):
        """
        Draws of the number of AGN from a fraction on, by the selected ones.

        Bins of which no injected AGN is selected have the share of all bins.
        """
        kind = "above" if fraction == self.floor else "limit"
        n_z = len(self.bins.redshift) - 1
        rng = stream(self.seed, "agn", "corrected", kind)
        n_right = int(self.injected["right"][:n_z].sum())
        n_injected = int(self.injected[kind][:n_z].sum())
        of_all = self._selected_share(rng, n_right, n_injected)
        total = np.zeros(self.draws.n_draws)
        n_uncorrected = 0.0
        for i in range(n_z):
            for k in range(self.bins.shape[2]):
                number = self._corrected(i, k, kind)
                if np.all(np.isfinite(number)):
                    total += number
                else:
                    n_uncorrected += self.pure[i, k]
        if n_uncorrected > 0:
            total += rng.standard_gamma(n_uncorrected, total.size) / of_all
        return total


def prior_table(bins, prior, by_redshift, all_redshifts):
    """
    Prior of the AGN fraction as shipped, and as measured on the sample.

    Parameters
    ----------
    bins : `~miricigale.fitting.AGNBins`
        The bins.
    prior : `~numpy.ndarray`, shape (n_frac,)
        Prior of the fits.
    by_redshift, all_redshifts : `~miricigale.agn.ShareDraws`
        Measured for each bin of redshift, and for all redshifts together.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each bin of the fraction, first for all redshifts, then for each of several bins.
    """
    edges = (0.0,) + tuple(bins.frac_agn)
    rows = []
    samples = [(bins.redshift[0], bins.redshift[-1], all_redshifts.shares[:, 0])]
    n_z = len(bins.redshift) - 1
    for i in range(n_z):
        # a single bin is that of all redshifts
        if n_z == 1:
            break
        samples.append((bins.redshift[i], bins.redshift[i + 1], by_redshift.shares[:, i]))
    for z_low, z_high, shares in samples:
        for j, shipped in enumerate(prior):
            row = {"redshift_low": z_low, "redshift_high": z_high}
            row |= {
                "frac_agn_low": edges[j],
                "frac_agn_high": edges[j + 1],
                "shipped": float(shipped),
            }
            rows.append(row | _summary(shares[:, j], "measured"))
    return described_rows(rows, _texts("prior"))
