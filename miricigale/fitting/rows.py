"""What posteriors of a catalog and draws from them have in common."""

from dataclasses import replace

import numpy as np

from miricigale.fitting.likelihood import FitFlags
from miricigale.fitting.posterior import check_levels
from miricigale.utils.declared import declared
from miricigale.utils.object_rows import ObjectRows
from miricigale.utils.options import check_that


def other_name(name, known):
    """
    Parameter or derived quantity that a name of CIGALE's or a usual one is.

    Parameters
    ----------
    name : str
        Such as ``"stellar.m_star"``, ``"bayes.sfh.sfr"``, ``"fracAGN"`` or ``"z"``.
    known : collection of str
        Those that there are, by our names.

    Returns
    -------
    name : str
        Ours, if it is one of ``known``; else the name as it was.

    Examples
    --------
    >>> from miricigale.fitting.rows import other_name
    >>> other_name("bayes.stellar.m_star", ["mass", "stellar_mass"])
    'stellar_mass'
    """
    if name in known or not isinstance(name, str):
        return name
    plain = name.removeprefix("bayes.").removeprefix("best.")
    usual = declared("miricigale.fitting", "columns.toml")["other_names"]
    if usual.get(plain) in known:
        return usual[plain]
    tables = declared("miricigale.cigale", "names.toml")
    pairs = [(ours, theirs) for ours, (theirs, _) in tables["quantities"].items()]
    for names in tables["modules"].values():
        pairs += names.items()
    return next((ours for ours, theirs in pairs if theirs == plain and ours in known), name)


class FitRows(ObjectRows):
    """Base of what fits return: objects that may be flagged as not fitted, and the model if it is known."""

    #: Where the formats of files are registered.
    io_module = "miricigale.fitting.io"
    _other_names = {"quantile": "percentile"}

    def with_model(self, model):
        """Return a copy that knows the `~miricigale.sed.SEDModel`, for other bands and for spectra."""
        return replace(self, model=model)

    def to_pandas(self):
        """The table as a `pandas.DataFrame`, without units."""
        return self.to_table().to_pandas()

    def _named(self, name):
        """Our name of a parameter or derived quantity."""
        return other_name(name, self.parameters)

    def interval(self, name, level=0.68):
        """
        Return central credible intervals.

        Parameters
        ----------
        name : str
            A parameter or derived quantity.
        level : float, optional
            Part of the posterior within, or percent of it: 0.68 and 68 are the same.

        Returns
        -------
        interval : `~astropy.units.Quantity`, shape (n, 2)
            Lower and upper ends, below and above which the same part of the posterior lies.
        """
        (level,) = check_levels([level])
        return self.percentile(name, [0.5 * (1.0 - level), 0.5 * (1.0 + level)])

    def flag_names(self):
        """Names of the flags of each object: list of lists of str."""
        return [FitFlags.names(value) for value in np.atleast_1d(self.flags)]

    def __add__(self, other):
        return type(self).concatenate([self, other])

    def _fitted_one(self):
        """Refuse a single object that was not fitted."""
        names = ", ".join(FitFlags.names(self.flags)) or "no draws"
        got = f"{np.asarray(self.ids).item()!r} ({names})"
        check_that(self.fitted, "key", "the id of an object that was fitted", got)
        return self
