"""Formats of tables by the suffix of a file."""

from pathlib import Path

from miricigale.utils.options import check_that

#: Formats that are read, as `astropy.table.Table` calls them.
TABLE_FORMATS = {
    ".fits": "fits",
    ".fit": "fits",
    ".ecsv": "ascii.ecsv",
    ".csv": "ascii.csv",
    ".xml": "votable",
    ".vot": "votable",
    ".votable": "votable",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".parquet": "parquet",
}
#: Formats that are written: plain text keeps the units too.
WRITTEN_FORMATS = TABLE_FORMATS | {".txt": "ascii.ecsv", ".dat": "ascii.ecsv"}


def check_keeps_units(path):
    """Refuse the path of a table in a format without units (a `ValueError`)."""
    wanted = "a file of a format with units, such as .ecsv or .fits"
    check_that(table_suffix(path) != ".csv", "path", wanted, str(path))


def table_suffix(path):
    """Suffix of a file in lower case, without that of its packing."""
    name = Path(path).name.lower()
    for packing in (".gz", ".bz2", ".xz", ".zip"):
        name = name.removesuffix(packing)
    return Path(name).suffix
