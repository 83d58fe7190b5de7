"""Which AGN are injected: batches, until the completeness of every bin is known well enough."""

import numpy as np

from miricigale.evaluation import Estimate
from miricigale.utils.random import stream

#: AGN of each bin in the first batch. With 50 a completeness of 0.05 comes out 0.007 too low, because batches end
#: where few are selected by chance; with 100 all are within 0.005.
FIRST = 100
#: Golden ratio, whose multiples fill an interval evenly, however many there are.
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
#: Injections beyond those that a bin seems to need, so that it seldom needs a few more in the end.
_MARGIN = 1.1


class InjectionDraws:
    """
    Hosts and luminosities of AGN, drawn in batches for bins of redshift and luminosity.

    Parameters
    ----------
    hosts : list of int `~numpy.ndarray`
        Rows of the galaxies of each bin of redshift. Those of a bin are taken in turn, each as often as others.
    log_luminosity : tuple of float
        Edges of the bins of log10 of the luminosity. Above the last one there is another bin, as wide as the last.
        Luminosities fill a bin evenly, more so than random ones do.
    seed : int
        Seed.
    """

    def __init__(self, hosts, log_luminosity, seed):
        edges = list(log_luminosity)
        # above the last edge as far as below the last but one
        step = edges[-1] - edges[-2] if len(edges) > 1 else 1.0
        self.edges = edges + [edges[-1] + step]
        self.hosts = hosts
        self.seed = seed
        self.cells = []
        for i in range(len(hosts)):
            if len(hosts[i]):
                self.cells += [(i, k) for k in range(len(self.edges) - 1)]

    def draw(self, first, sizes):
        """
        Draw AGN.

        Parameters
        ----------
        first, sizes : int `~numpy.ndarray`, shape (n_cells,)
            Number of AGN of each bin that were drawn before, and of those that are wanted.

        Returns
        -------
        cell, row : int `~numpy.ndarray`, shape (n,)
            Bin and host of each.
        log_luminosity : `~numpy.ndarray`, shape (n,)
        """
        cells = []
        rows = []
        luminosities = []
        for cell, (i, k) in enumerate(self.cells):
            number = first[cell] + np.arange(sizes[cell])
            start = stream(self.seed, "agn", "luminosities", i, k).random()
            place = (start + _GOLDEN * number) % 1.0
            low = self.edges[k]
            high = self.edges[k + 1]
            cells.append(np.full(number.size, cell))
            rows.append(self._hosts(i, k, number))
            luminosities.append(low + (high - low) * place)
        return np.concatenate(cells), np.concatenate(rows), np.concatenate(luminosities)

    def _hosts(self, i, k, number):
        """Rows of the hosts of a bin: all of them in random order, then all in another one, and so on."""
        hosts = self.hosts[i]
        rounds, place = np.divmod(number, len(hosts))
        rows = np.zeros(number.size, int)
        for turn in np.unique(rounds):
            order = stream(self.seed, "agn", "hosts", i, k, int(turn)).permutation(hosts)
            chosen = rounds == turn
            rows[chosen] = order[place[chosen]]
        return rows


def batch_sizes(n_drawn, n_injected, n_selected, *, error, n_left):
    """
    Find how many AGN of each bin are injected next.

    Parameters
    ----------
    n_drawn, n_injected, n_selected : int `~numpy.ndarray`, shape (n_cells,)
        AGN of each bin that were drawn before, that could be injected, and that were selected.
    error : float
        Wanted error of the completeness: the further end of its 68 % interval (Wilson). With 0 there are never
        enough.
    n_left : int
        Most AGN of all bins. If bins want more together, each gets less in proportion.

    Returns
    -------
    sizes : int `~numpy.ndarray`, shape (n_cells,)
        `FIRST` in the first batch, and at most as many as before in others; 0 in bins that have enough, and where
        no AGN could be injected.
    """
    wanted = np.zeros(len(n_drawn), int)
    for cell in range(len(n_drawn)):
        if not n_drawn[cell]:
            wanted[cell] = FIRST
        elif n_injected[cell]:
            wanted[cell] = _more(int(n_injected[cell]), int(n_selected[cell]), error)
    total = wanted.sum()
    if total <= n_left:
        return wanted
    sizes = wanted * n_left // total
    # what was lost by rounding, to the first bins that want more
    remaining = n_left - sizes.sum()
    sizes[np.flatnonzero(sizes < wanted)[:remaining]] += 1
    return sizes


def _more(n, n_selected, error):
    """How many more AGN a bin with ``n`` of them needs, at most as many again; 0 if it has enough."""
    share = Estimate.of_fraction(n_selected, n)
    if max(share.high - share.value, share.value - share.low) <= error:
        return 0
    if error == 0:
        return n
    # half a pseudo-object of each kind, for a share of 0 or 1 is not known to be that
    expected = (n_selected + 0.5) / (n + 1.0)
    needed = int(np.ceil(_MARGIN * expected * (1.0 - expected) / error**2))
    return min(max(needed - n, n // 10 + 1), n)
