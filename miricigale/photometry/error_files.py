"""Files of error models (curves) and of error calibrations (sources of known flux)."""

import dataclasses

from miricigale.photometry.error_calibration import ErrorCalibration
from miricigale.photometry.error_model import ErrorModel
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import read_table
from miricigale.utils.store import replacing
from miricigale.utils.unified import register


def write_ecsv(table, path, *, overwrite=False):
    """Write a table as ECSV, whole or not at all."""
    with replacing(path, overwrite=overwrite) as partial:
        table.write(partial, format="ascii.ecsv")


def _reader(make, wanted):
    def read(path):
        table = read_table(path, wanted=wanted, form="ascii.ecsv")
        try:
            return make(table)
        except (TypeError, ValueError) as err:
            msg = f"{path} is no {wanted.removeprefix('an ').removeprefix('a ')}: {err}"
            raise DataError(msg) from err

    return read


def _calibration(table):
    return dataclasses.replace(ErrorCalibration.from_sources(table), meta=dict(table.meta))


def _write_model(model, path, *, overwrite=False):
    write_ecsv(model.to_table(), path, overwrite=overwrite)


def _write_calibration(calibration, path, *, overwrite=False):
    table = calibration.sources.copy()
    table.meta = dict(calibration.meta)
    write_ecsv(table, path, overwrite=overwrite)


register(
    ErrorModel,
    read=_reader(ErrorModel.from_table, "an error model"),
    write=_write_model,
    name="ascii.ecsv",
)
register(
    ErrorCalibration,
    read=_reader(_calibration, "a calibration of errors"),
    write=_write_calibration,
    name="ascii.ecsv",
)
