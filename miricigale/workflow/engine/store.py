"""The folder of a run: its products, the record of what stands, and the configuration."""

import shutil
from pathlib import Path

from miricigale.utils.exceptions import DataError
from miricigale.utils.folder import RecordFolder

CONFIG = "config.toml"


class ProductStore(RecordFolder):
    """
    The folder of a run; see `~miricigale.utils.folder.RecordFolder`.

    Records are by stage, or stage and unit, and have ``seconds`` too.

    Parameters
    ----------
    folder : path-like
        Made when something is written, if it does not exist.

    Examples
    --------
    >>> import tempfile
    >>> from miricigale.workflow import ProductStore
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     store = ProductStore(folder)
    ...     print(store.records)
    {}
    """

    records_name = "stages"
    remedy = "choose another with --output"

    @property
    def config(self):
        """Plain values of the configuration that the products were made with; None if not known."""
        return self.facts.get("config")

    def check_record(self, record):
        super().check_record(record)
        float(record["seconds"])

    def checksums(self, keys):
        """Return checksums of all products of units by their keys; those that are not done have none."""
        checksums = {}
        for key in sorted(self.records.keys() & set(keys)):
            for name, product in self.records[key]["products"].items():
                checksums[name] = product["sha256"]
        return checksums


def check_disk(folder, needed):
    """
    Refuse to begin where the products would not fit.

    Parameters
    ----------
    folder : path-like
        Where they will go.
    needed : int
        Bytes beside what stands there.

    Returns
    -------
    n_free : int
        Bytes that are free.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If less than that is free.
    """
    place = Path(folder).absolute()
    while not place.exists():
        place = place.parent
    n_free = shutil.disk_usage(place).free
    if needed > n_free:
        msg = (
            f"the run needs about {needed / 1e9:.2f} GB in {folder}, only {n_free / 1e9:.2f} GB are "
            "free; free some space, choose another folder, or simulate fewer exposures or skies"
        )
        raise DataError(msg)
    return n_free
