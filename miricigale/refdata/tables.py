"""Reading of the bundled tables: images of FITS files, as read-only arrays."""

from miricigale.utils.exceptions import file_errors
from miricigale.utils.files import cached_by_file, open_fits
from miricigale.utils.units import frozen_array

SOLAR_LUMINOSITY = 3.828e26  # W, IAU 2015


def read_images(path, names, *, wanted):
    """
    Return the images of a FITS file by the names of their extensions: dict of read-only arrays of float.

    What ``wanted`` says that the file should be stands in the `DataError` if it is something else.
    """
    with file_errors(path, f"is not {wanted}"), open_fits(path, wanted=wanted) as hdus:
        images = {}
        for name in names:
            images[name] = frozen_array(hdus[name].data)
        return images


@cached_by_file(maxsize=2)
def load_ssp(path):
    """
    Read the bundled simple stellar populations.

    Wavelengths in um, ages in Myr, and by metallicity: spectra, shape (n_age, n_wave), in W/um for
    one solar mass formed, and the mass fraction in surviving stars, without remnants.
    """
    wanted = "a table of simple stellar populations"
    part = read_images(path, ("WAVE", "AGE", "LIVING"), wanted=wanted)
    names = [f"Z{k + 1}" for k in range(len(part["LIVING"]))]
    with open_fits(path, wanted=wanted) as hdus:
        metallicities = [float(hdus[name].header["METAL"]) for name in names if name in hdus]
    images = read_images(path, names, wanted=wanted).values()
    spectra = [frozen_array(image * (SOLAR_LUMINOSITY * 1e4)) for image in images]
    return (
        frozen_array(part["WAVE"] / 1e4),
        frozen_array(part["AGE"] / 1e6),
        dict(zip(metallicities, spectra, strict=True)),
        dict(zip(metallicities, part["LIVING"], strict=True)),
    )
