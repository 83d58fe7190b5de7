"""Tables whose columns of bands are found by any name of the band."""

from miricigale.filters.band_names import find_filter
from miricigale.utils.result_table import ResultTable


class BandTable(ResultTable):
    """
    A `~astropy.table.QTable` in which ``table["F770W"]`` is the column ``miri.f770w``.

    So is ``table["F770W_err"]`` the column ``miri.f770w_err``, and so on with any name of a filter; and
    ``table["redshift"]`` the posterior median, ``redshift_p50``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.filters.band_table import BandTable
    >>> table = BandTable({"miri.f770w": [1, 2] * u.uJy, "miri.f770w_err": [0.1, 0.1] * u.uJy})
    >>> table["F770W"]
    <Quantity [1., 2.] uJy>
    >>> table["F770W", "JWST/MIRI.F770W_err"].colnames
    ['miri.f770w', 'miri.f770w_err']
    """

    def __getitem__(self, item):
        if isinstance(item, str):
            item = self._column_name(item)
        elif isinstance(item, (list, tuple)) and all(isinstance(name, str) for name in item):
            item = [self._column_name(name) for name in item]
        return super().__getitem__(item)

    def _column_name(self, name):
        """Return the name of a column by another name of its band; itself if there is none."""
        if name in self.columns:
            return name
        # endings such as _err stand after the name of a band, which may have dashes of its own
        parts = name.split("_")
        for n_parts in range(len(parts), 0, -1):
            band = find_filter("_".join(parts[:n_parts]))
            column = "_".join([band or "", *parts[n_parts:]])
            if column in self.columns:
                return column
        if f"{name}_p50" in self.columns:
            return f"{name}_p50"
        return name
