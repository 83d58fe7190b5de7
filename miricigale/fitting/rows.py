"""What posteriors of a catalog and draws from them have in common."""

from dataclasses import replace

import numpy as np

from miricigale.fitting.likelihood import FitFlags
from miricigale.utils.object_rows import ObjectRows
from miricigale.utils.options import check_that


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
