"""Files of error models (curves) and of error calibrations (sources of known flux)."""

from miricigale.photometry.errors.error_calibration import ErrorCalibration
from miricigale.photometry.errors.error_model import ErrorModel
from miricigale.utils.exceptions import file_errors
from miricigale.utils.file_formats import register
from miricigale.utils.table_files import read_table, write_ecsv


def _reader(cls, kind):
    def read(path):
        table = read_table(path, wanted=kind, form="ascii.ecsv")
        with file_errors(path, f"is not {kind}"):
            return cls.from_table(table)

    return read


for _cls, _kind in ((ErrorModel, "an error model"), (ErrorCalibration, "a calibration of errors")):
    register(_cls, read=_reader(_cls, _kind), write=write_ecsv, name="ascii.ecsv")
