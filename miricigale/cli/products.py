"""Commands of single products: show, psf, cite."""

import warnings
from pathlib import Path

from miricigale.cli.bibliography import bibtex
from miricigale.utils.options import check_that
from miricigale.utils.outputs import check_output

#: Endings of files that may be products.
_PRODUCTS = (".fits", ".fit", ".gz", ".ecsv", ".parquet", ".asdf")


def _readers():
    """Yield functions that read a product, the most particular first."""
    from miricigale.fitting import FitResults
    from miricigale.photometry import ErrorModel, ForcedPhotometryResult, read_mosaic
    from miricigale.psf import InstrumentPSF, MatchingKernel, read_psf
    from miricigale.reduction import open_exposure
    from miricigale.utils.table_files import read_table

    for cls in (FitResults, ForcedPhotometryResult, MatchingKernel, InstrumentPSF, ErrorModel):
        yield cls.read
    yield open_exposure
    yield read_mosaic
    yield read_psf
    yield lambda path: read_table(path, wanted="a table")


def open_product(path):
    """
    Open a file of any kind.

    Parameters
    ----------
    path : path-like
        A product of the package, a file of JWST, any FITS image or table, or ``pcigale.ini``.

    Returns
    -------
    product : object
        Of the class that reads it: `~miricigale.fitting.FitResults`, `~miricigale.detector.Ramp`, ...

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no such file, or it is nothing of these.
    """
    from astropy.io.registry import IORegistryError

    from miricigale.utils.exceptions import data_error
    from miricigale.utils.options import check_is_file

    # of a reader for a file of another kind
    unsuitable = (OSError, ValueError, KeyError, TypeError, IORegistryError)
    path = Path(path)
    check_is_file(path)
    if path.suffix.lower() == ".ini":
        from miricigale.cigale import read_pcigale_ini

        return read_pcigale_ini(path)
    with warnings.catch_warnings():
        # they are about what was tried
        warnings.simplefilter("ignore")
        reason = ""
        for read in _readers():
            try:
                return read(path)
            except unsuitable as err:
                # the last reader is that of tables
                reason = str(err).partition("cannot be read as a table: ")[2]
    problem = "is no product, image or table that can be read"
    if reason:
        problem += f" (as a table: {reason})"
    raise data_error(path, problem)


def show(args):
    """Say what a file is, and draw it; or what the files of a folder are."""
    from astropy.table import Table

    if args.file.is_dir():
        check_that(args.picture is None, "picture", "left out for a folder", args.picture)
        show_folder(args.file)
        return 0
    product = open_product(args.file)
    print(f"{args.file}: {type(product).__name__}")
    if isinstance(product, Table):
        with warnings.catch_warnings():
            # astropy formats statistics of columns without a value
            warnings.simplefilter("ignore", FutureWarning)
            product.info("stats")
    elif hasattr(product, "summary"):
        print(product.summary())
    else:
        print(product)
    if args.picture is None:
        if hasattr(product, "plot"):
            print("--picture draws it")
        return 0
    wanted = "left out for what has no picture"
    check_that(hasattr(product, "plot"), "picture", wanted, type(product).__name__)
    if args.picture.name:
        picture = args.picture
    else:
        picture = Path(f"{args.file.name}.png")
    check_output(picture, "picture", overwrite=args.overwrite, inputs=[args.file])
    from matplotlib import pyplot as plt

    plt.switch_backend("agg")
    # a figure of its own, not the one of a session that calls this
    plt.figure()
    product.plot()
    plt.gcf().savefig(picture, dpi=120)
    plt.close()
    print(f"picture: {picture}")
    return 0


def show_folder(folder):
    """
    Print what the products in a folder and below are, one line each.

    Parameters
    ----------
    folder : `~pathlib.Path`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there are none.
    """
    from astropy.table import Table

    from miricigale.utils.options import check_data

    files = _product_files(folder)
    check_data(files, folder, f"has no files of products ({', '.join(_PRODUCTS)})")
    for file in files:
        try:
            product = open_product(file)
        except OSError:
            print(f"{file}: nothing that can be read")
            continue
        if isinstance(product, Table):
            line = f"{len(product)} rows, {len(product.columns)} columns"
        else:
            line = repr(product).splitlines()[0]
        print(f"{file}: {type(product).__name__}, {line}")


def _product_files(folder):
    """Return the files in a folder and below that may be products, in order."""
    files = sorted(folder.rglob("*"))
    return [file for file in files if file.suffix.lower() in _PRODUCTS and file.is_file()]


def psf(args):
    """Write the PSF of a mosaic, or of a single exposure in a filter."""
    from miricigale.filters.band_names import find_filter
    from miricigale.photometry import MosaicFile
    from miricigale.photometry.commands.kernel_files import image_psf
    from miricigale.psf import MODEL_FILTERS
    from miricigale.psf.by_filter import exposure_psf

    band = find_filter(args.image)
    if band in MODEL_FILTERS and not Path(args.image).exists():
        wanted = "left out without an image"
        for name in ("filter", "pa_aper"):
            check_that(getattr(args, name) is None, name, wanted, getattr(args, name))
        model = exposure_psf(band)
    else:
        model = image_psf(MosaicFile(args.image, filter=args.filter, pa_aper=args.pa_aper))
    wanted = f"an image of a filter with a model ({', '.join(MODEL_FILTERS)}) and its PA_APER"
    check_that(model is not None, "IMAGE", wanted, args.image)
    check_output(args.output, "output", overwrite=args.overwrite, inputs=[args.image])
    model.write(args.output, overwrite=args.overwrite)
    print(f"{args.output}: FWHM {model.fwhm:.4f}, pixel {model.pixel_scale:.4f}")
    return 0


def cite(args):
    """Print what to cite."""
    from miricigale import __version__

    sources = [
        f"miricigale {__version__} (CITATION.cff)",
        "Yang et al. 2021, ApJ 908, 144 (the study that it repeats)",
    ]
    note = "and what 'miricigale cite FILE' names for the products that you use"
    if args.file is not None:
        of_product = citations_of(args.file)
        note = None
        if of_product:
            sources = of_product
        else:
            note = f"{args.file} names no data or methods beside the package"
    if args.bibtex:
        print(bibtex(sources))
        return 0
    print("\n".join(sources))
    if note:
        print(note)
    return 0


def citations_of(path):
    """
    Return what products name to be cited, each once, in the order of the files.

    Parameters
    ----------
    path : `~pathlib.Path`
        A product, or a folder of products, such as that of a study.

    Returns
    -------
    citations : list of str
    """
    if not path.is_dir():
        return list(getattr(open_product(path), "meta", {}).get("citations", ()))
    citations = {}
    for file in _product_files(path):
        try:
            product = open_product(file)
        except OSError:
            # of another program
            continue
        citations |= dict.fromkeys(getattr(product, "meta", {}).get("citations", ()))
    return list(citations)
