"""
Compile the kernels of a run before they are needed, side by side in several processes.

Each job calls the classes that a run calls, on next to nothing, so that numba compiles what the run
will need and keeps it on disk; the run then only loads it. What is compiled already is known from
marker files, without numba.
"""

import contextlib
import hashlib
import importlib.metadata
import logging
import os
import subprocess
import sys
import threading
from pathlib import Path

import llvmlite.binding as llvm

from miricigale.utils.files import make_folder
from miricigale.utils.parallel import parallel_map, threads

# shown by the command line at any verbosity
log = logging.getLogger("miricigale.utils.compilation")

_PACKAGE = Path(__file__).resolve().parent.parent


def _fit():
    """Evaluate model spectra, and fit them at a free and at a fixed redshift."""
    import astropy.units as u
    from astropy.table import QTable

    from miricigale.fitting import BayesFitter
    from miricigale.sed import SEDModel

    bands = ["wfc3.f160w", "irac.ch1", "miri.f770w", "miri.f1500w", "miri.f2100w"]
    table = QTable({"id": [1], "redshift": [1.0], "mass": [1e10]})
    SEDModel.yang2021(agn=False).fluxes(table, bands)
    # with frac_agn = 0 the AGN would be skipped
    table["frac_agn"] = [0.4]
    SEDModel.yang2021().fluxes(table, bands)
    axes = SEDModel.yang2021_axes("quick")
    for name in axes:
        axes[name] = axes[name][:2]
    fitter = BayesFitter(SEDModel.yang2021(), bands, axes=axes, model_error=0.1)
    for k, name in enumerate(bands):
        table[name] = [1.0 + k] * u.uJy
        table[f"{name}_err"] = [0.5] * u.uJy
    fitter.fit(table)
    fitter.fit(table, redshift="redshift")


def _images():
    """Expose, reduce and drizzle a galaxy and a star, and draw the prior."""
    import astropy.units as u
    from astropy.coordinates import SkyCoord

    from miricigale.instrument import Exposure, north_up_wcs
    from miricigale.reduction import RampSettings, Reducer
    from miricigale.workflow.config import load_config
    from miricigale.workflow.stages.images import expose_and_reduce, prior_image, reducer_of
    from miricigale.workflow.stages.points import point_catalog

    center = SkyCoord(53.1344 * u.deg, -27.83444 * u.deg)
    # options that are off by default call further kernels
    overrides = {"detector": {"residual": 0.01}}
    config = load_config("goodss", quick=True, overrides=overrides)
    exposure = Exposure(
        "miri.f770w", n_groups=12, subarray="SUB64", pointing=center, roll=0 * u.deg
    )
    catalog = point_catalog(exposure, 3 * u.uJy, config.highres.filter, spacing=100, seed=1)[:2]
    # a galaxy and a star
    catalog["sky"] = center.directional_offset_by(45 * u.deg, [0, 1.4] * u.arcsec)
    catalog["profile"] = ["sersic", "point"]
    catalog["half_light_radius"] = [0.3, 0.0] * u.arcsec
    ramps = []
    images = []
    for n in (1, 2):
        for dither in exposure.replace(n_integrations=n).dithered("ceers", 2):
            _, image = expose_and_reduce(
                config, dither, catalog, seed=1, n_threads=2, keep=ramps.append
            )
            images.append(image)
    # low thresholds, so that few pixels contain large jumps
    Reducer(jump_threshold=2.0, ramps=RampSettings(neighbor_threshold=2.0)).fit_ramp(ramps[0])
    grid = north_up_wcs(center, 0.06 * u.arcsec, (128, 128))
    reducer_of(config).drizzle(images, grid)
    prior_image(config, catalog, grid, seed=1)


def _photometry():
    """Detect and measure three sources, wider than the PSF, so that profiles are fitted."""
    import astropy.units as u
    import numpy as np
    from astropy.coordinates import SkyCoord
    from astropy.nddata import CCDData, StdDevUncertainty
    from scipy.ndimage import gaussian_filter

    from miricigale.instrument import north_up_wcs
    from miricigale.photometry import ForcedPhotometer, detect_sources
    from miricigale.psf import MatchingKernel, gaussian_psf

    rng = np.random.default_rng(1)
    sky = SkyCoord([-1.0, 0.5, 1.5] * u.arcsec, [-1.0, 0.5, 1.0] * u.arcsec)

    def image(scale, size, width):
        wcs = north_up_wcs(SkyCoord(0 * u.deg, 0 * u.deg), scale, (size, size))
        y, x = np.mgrid[:size, :size]
        # correlated noise, as in a mosaic
        light = 0.03 * gaussian_filter(rng.standard_normal(y.shape), 1.0)
        for px, py in zip(*wcs.world_to_pixel(sky), strict=True):
            light += np.exp(-0.5 * ((x - px) ** 2 + (y - py) ** 2) / width**2)
        return CCDData(
            np.asarray(light, np.float32),
            uncertainty=StdDevUncertainty(np.full(y.shape, 0.01, np.float32)),
            unit="MJy/sr",
            wcs=wcs,
            mask=np.zeros(y.shape, bool),
        )

    fine = 0.06 * u.arcsec
    native = 0.11 * u.arcsec
    prior = image(fine, 132, 2.5)
    mosaic = image(native, 72, 1.8)
    kernel = MatchingKernel.from_psfs(
        gaussian_psf(0.2 * u.arcsec, pixel_scale=fine, fov=3 * u.arcsec),
        gaussian_psf(0.3 * u.arcsec, pixel_scale=native, fov=3 * u.arcsec),
        pixel_scale=fine,
    )
    photometer = ForcedPhotometer(kernel, background_order=0)
    segments, sources = detect_sources(prior, threshold=10)
    photometer.measure(mosaic, prior, segments, sources)


#: What is compiled together: what it is, and about how many seconds it takes on a slow machine.
JOBS = {
    "fit": (_fit, "model spectra and their fit", 60),
    "images": (_images, "scenes, detector and reduction", 50),
    "photometry": (_photometry, "photometry", 60),
}


def compile_missing(n_threads):
    """
    Compile what is not compiled yet, each job in a process of its own.

    Parameters
    ----------
    n_threads : int
        Jobs side by side.

    Returns
    -------
    is_kept : bool
        Whether all kernels are on disk.
    """
    names = [name for name in JOBS if not is_compiled(name)]
    for name in names:
        _, title, seconds = JOBS[name]
        log.info("compiling %s, once for each installation, up to %d s", title, seconds)
    with threads(n_threads) as executor:
        return all(parallel_map(compile_apart, names, executor=executor))


def compile_job(name):
    """
    Run one job of `JOBS` in this process, and note that its kernels are on disk.

    Returns whether they are.
    """
    JOBS[name][0]()
    path = _marker(name)
    with contextlib.suppress(OSError):
        make_folder(path.parent)
        path.touch()
    return is_compiled(name)


def compile_apart(name):
    """
    Run one job in a process of its own, which ends with this one.

    A process that has compiled a kernel uses other copies of what that calls than one that loads
    it from disk, and they may differ in the last digit of a sum: if all processes of a run load
    their kernels, the first run gives the same bytes as the next.

    Parameters
    ----------
    name : str
        One of `JOBS`.

    Returns
    -------
    is_kept : bool
        Whether its kernels are on disk.
    """
    # the package may have been found by a path that the child would not have
    code = (
        "import sys; sys.path.append(sys.argv[2]); "
        f"from {__name__} import compile_and_end; compile_and_end(sys.argv[1])"
    )
    with subprocess.Popen(
        # -P: do not import modules from the current working directory
        [sys.executable, "-P", "-c", code, name, str(_PACKAGE.parent)],
        # the pipe closes when this process ends, even if it is killed
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        # Ctrl-C in the terminal reaches this process only
        start_new_session=True,
    ) as child:
        child.wait()
    return is_compiled(name)


def is_compiled(name):
    """Tell whether the kernels of a job were compiled by this installation, on this machine."""
    marker = _marker(name)
    # the cache may have been emptied without removing the marker
    folder = _PACKAGE
    if marker.parent.name != "__pycache__":
        folder = _numba_folder()
    return marker.is_file() and any(folder.rglob("*.nbi"))


def _marker(name):
    return _cache_folder() / f"miricigale-{name}-{_key()}"


def _cache_folder():
    """Tell where numba keeps compiled code, or near it."""
    if "NUMBA_CACHE_DIR" not in os.environ and os.access(_PACKAGE, os.W_OK):
        return _PACKAGE / "__pycache__"
    return _numba_folder()


def _numba_folder():
    """Return the folder of compiled code that numba cannot keep with the source."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    if folder:
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "numba"


def _key():
    """Return a hash of what compiled code depends on: sources as numba sees them, packages, processor."""
    parts = [
        str(_PACKAGE),
        sys.version,
        llvm.get_host_cpu_name(),
        llvm.get_host_cpu_features().flatten(),
        os.environ.get("NUMBA_CPU_NAME", ""),
    ]
    for name in ("numba", "llvmlite", "numpy"):
        parts.append(importlib.metadata.version(name))
    sources = list(_PACKAGE.glob("*/_core.py"))
    sources += _PACKAGE.glob("*/_core/*.py")
    for path in sorted(sources):
        state = path.stat()
        parts.append(f"{path.relative_to(_PACKAGE)} {state.st_size} {state.st_mtime_ns}")
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def compile_and_end(name):
    """Run one job as the whole of a process, which also ends when its stdin is closed."""
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    compile_job(name)
    # not sys.exit: the thread holds the lock of stdin
    os._exit(0)


def _end_with_stdin():
    sys.stdin.buffer.read()
    os._exit(1)
