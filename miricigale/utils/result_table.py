"""Tables of results, whose metadata FITS files keep."""

from astropy.table import QTable

from miricigale.utils.table_files import write_table


class ResultTable(QTable):
    """
    A `~astropy.table.QTable` that is written to FITS with all of its metadata.

    Examples
    --------
    >>> from miricigale.utils.result_table import ResultTable
    >>> table = ResultTable({"id": [1]}, meta={"pixel_scale": 0.06})
    >>> table.write("fluxes.fits")  # doctest: +SKIP
    """

    def write(self, *args, **options):
        """
        Write the table, as `astropy.table.Table.write` does.

        Where the name of the file alone says that it is FITS, the metadata are kept as JSON in the card ``META``,
        and the unit dex, which FITS does not know: astropy warns of each name of more than eight letters, and
        leaves both out with a warning where it cannot write them.
        """
        is_fits = len(args) == 1 and str(args[0]).lower().endswith((".fits", ".fits.gz"))
        if is_fits and set(options) <= {"overwrite"}:
            write_table(self, args[0], **options)
        else:
            super().write(*args, **options)
