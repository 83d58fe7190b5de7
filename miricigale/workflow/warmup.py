"""
Compile the kernels of a run side by side, in processes of their own, before they are needed.

Each job calls the classes that a run calls, on next to nothing, so that numba compiles what the run
will need and keeps it on disk; the run then only loads it. What is compiled already is known from
marker files, without numba.
"""

import dataclasses
import hashlib
import importlib.metadata
import logging
import os
import platform
import queue
import signal
import subprocess
import sys
import threading
from pathlib import Path

from miricigale.utils.exceptions import argument_error

__all__ = ["JOBS", "CompileHandle", "compile_in_background", "compile_job", "is_compiled"]

log = logging.getLogger(__name__)


def _fit():
    from miricigale.fitting import BayesFitter
    from miricigale.sed import SEDModel

    fitter = BayesFitter(SEDModel.yang2021(), _BANDS, axes=_axes(), model_error=0.1)
    table = _photometry_table()
    fitter.fit(table)
    table["z"] = [1.0]
    fitter.fit(table, redshift="z")


def _sed():
    from astropy.table import QTable

    from miricigale.sed import SEDModel

    SEDModel.yang2021().grid(_axes(), _BANDS)
    for agn in (False, True):
        table = QTable({"id": [1], "redshift": [1.0], "mass": [1e10]})
        SEDModel.yang2021(agn=agn).fluxes(table, _BANDS)


def _images():
    import astropy.units as u
    from astropy.coordinates import SkyCoord

    from miricigale.instrument import Exposure, north_up_wcs
    from miricigale.photometry import detect_sources
    from miricigale.psf import hst_psf
    from miricigale.scene import highres_image
    from miricigale.workflow.config import load_config
    from miricigale.workflow.stages.images import expose_and_reduce, reducer_of

    config = load_config("goodss", quick=True)
    center = SkyCoord(config.pointing.ra * u.deg, config.pointing.dec * u.deg)
    catalog = _catalog(center)
    exposures = Exposure(
        "miri.f770w", n_groups=12, subarray="SUB64", pointing=center, roll=0 * u.deg
    ).dithered("ceers", 2)
    for n_integrations in (1, 2):
        images = [
            expose_and_reduce(
                config,
                dataclasses.replace(exposure, n_integrations=n_integrations),
                catalog,
                seed=1,
                n_threads=2,
            )[1]
            for exposure in exposures
        ]
    grid = north_up_wcs(center, 0.06 * u.arcsec, (128, 128))
    reducer_of(config).drizzle(images, grid)
    prior = highres_image(
        catalog, filter="wfc3.f160w", wcs=grid, psf=hst_psf(), depth=27.6 * u.ABmag, seed=1
    )
    detect_sources(prior)


def _photometry():
    import astropy.units as u
    import numpy as np
    from astropy.coordinates import SkyCoord
    from astropy.nddata import CCDData, StdDevUncertainty
    from astropy.table import QTable
    from photutils.segmentation import SegmentationImage

    from miricigale.instrument import north_up_wcs
    from miricigale.photometry import ForcedPhotometer
    from miricigale.psf import MatchingKernel, gaussian_psf

    center = SkyCoord(0 * u.deg, 0 * u.deg)
    hires, native = (
        north_up_wcs(center, scale * u.arcsec, (size, size))
        for scale, size in ((0.06, 132), (0.11, 72))
    )
    rng = np.random.default_rng(1)
    ids = np.arange(1, 4)
    sky = SkyCoord([-1.0, 0.5, 1.5] * u.arcsec, [-1.0, 0.5, 1.0] * u.arcsec)

    def image(wcs, width):
        y, x = np.mgrid[: wcs.pixel_shape[1], : wcs.pixel_shape[0]]
        light = 0.01 * rng.standard_normal(y.shape)
        for px, py in zip(*wcs.world_to_pixel(sky), strict=True):
            light += np.exp(-0.5 * ((x - px) ** 2 + (y - py) ** 2) / width**2)
        return CCDData(
            np.asarray(light, np.float32),
            unit="MJy/sr",
            wcs=wcs,
            uncertainty=StdDevUncertainty(np.full(y.shape, 0.01, np.float32)),
            mask=np.zeros(y.shape, bool),
        )

    prior, mosaic = image(hires, 1.5), image(native, 1.2)
    labels = np.zeros(prior.shape, np.int32)
    x, y = hires.world_to_pixel(sky)
    yy, xx = np.mgrid[: labels.shape[0], : labels.shape[1]]
    for k in range(3):
        labels[(xx - x[k]) ** 2 + (yy - y[k]) ** 2 < 36] = ids[k]
    kernel = MatchingKernel.from_psfs(
        gaussian_psf(0.2 * u.arcsec, pixel_scale=0.06 * u.arcsec, fov=3 * u.arcsec),
        gaussian_psf(0.3 * u.arcsec, pixel_scale=0.11 * u.arcsec, fov=3 * u.arcsec),
        pixel_scale=0.06 * u.arcsec,
    )
    ForcedPhotometer(kernel, fit_background=True).measure(
        mosaic, prior, SegmentationImage(labels), QTable({"id": ids, "sky": sky})
    )


_BANDS = ["wfc3.f160w", "irac.ch1", "miri.f770w", "miri.f1500w", "miri.f2100w"]


def _axes():
    from miricigale.sed import SEDModel

    axes = SEDModel.yang2021_axes("quick")
    return {name: values[:2] for name, values in axes.items()}


def _photometry_table():
    import astropy.units as u
    from astropy.table import QTable

    table = QTable({"id": [1]})
    for k, name in enumerate(_BANDS):
        table[name] = [1.0 + k] * u.uJy
        table[f"{name}_err"] = [0.5] * u.uJy
    return table


def _catalog(center):
    """A galaxy and a star."""
    import astropy.units as u
    from astropy.coordinates import SkyCoord
    from astropy.table import QTable

    return QTable(
        {
            "id": [1, 2],
            "sky": SkyCoord(center.ra + [0, 1] * u.arcsec, center.dec + [0, 1] * u.arcsec),
            "redshift": [1.0, 0.0],
            "profile": ["sersic", "point"],
            "half_light_radius": [0.3, 0.0] * u.arcsec,
            "sersic_index": [1.5, 1.0],
            "axis_ratio": [0.6, 1.0],
            "position_angle": [30.0, 0.0] * u.deg,
            "miri.f770w": [3.0, 5.0] * u.uJy,
            "wfc3.f160w": [3.0, 5.0] * u.uJy,
        }
    )


#: What is compiled together: what it is, and about how many seconds it takes on a slow machine.
JOBS = {
    "sed": (_sed, "model spectra", 15),
    "fit": (_fit, "the fit", 60),
    "images": (_images, "scenes, detector and reduction", 50),
    "photometry": (_photometry, "photometry", 20),
}


def _check(names):
    names = tuple(JOBS) if names is None else tuple(names)
    unknown = [name for name in names if name not in JOBS]
    if unknown:
        raise argument_error("jobs", f"of {', '.join(JOBS)}", unknown)
    return names


def compile_job(name):
    """
    Run one job in this process, and note that its kernels are on disk.

    Parameters
    ----------
    name : str
        One of `JOBS`.
    """
    JOBS[_check([name])[0]][0]()
    path = _marker(name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    except OSError:
        log.debug("%s cannot be written", path)


def is_compiled(name):
    """Whether the kernels of a job were compiled by this installation, on this machine."""
    return _marker(_check([name])[0]).is_file()


def _marker(name):
    return _cache_folder() / f"miricigale-{name}-{_key()}"


def _cache_folder():
    """Where numba keeps compiled code, or near it."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    if named:
        return Path(named)
    package = Path(__file__).resolve().parent.parent
    if os.access(package, os.W_OK):
        return package / "__pycache__"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "miricigale"


def _key():
    """What the compiled code depends on: the sources as numba sees them, packages, processor."""
    package = Path(__file__).resolve().parent.parent
    parts = [str(package), sys.version, _processor(), os.environ.get("NUMBA_CPU_NAME", "")]
    parts += [importlib.metadata.version(name) for name in ("numba", "llvmlite", "numpy")]
    for path in sorted([*package.glob("*/_core.py"), *package.glob("*/_core/*.py")]):
        state = path.stat()
        parts.append(f"{path.relative_to(package)} {state.st_size} {state.st_mtime_ns}")
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _processor():
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    wanted = ("model name", "flags", "Features", "CPU part")
    return "\n".join(dict.fromkeys(line for line in lines if line.startswith(wanted)))


class CompileHandle:
    """
    Jobs that compile in the background; made by `compile_in_background`.

    Parameters
    ----------
    names : tuple of str
        The jobs, in the order in which they begin.
    n_processes : int
        How many run at a time.
    """

    def __init__(self, names, n_processes):
        self._done = {name: threading.Event() for name in names}
        self._lock = threading.Lock()
        self._children = set()
        self._closed = False
        self._queue = queue.SimpleQueue()
        for name in names:
            self._queue.put(name)
        for _ in range(min(n_processes, len(names))):
            threading.Thread(target=self._work, daemon=True).start()

    def _work(self):
        """Run jobs one after the other."""
        while True:
            try:
                name = self._queue.get_nowait()
            except queue.Empty:
                return
            try:
                self._run(name)
            except OSError as err:
                log.debug("%s was not compiled in the background: %s", name, err)
            finally:
                self._done[name].set()

    def _run(self, name):
        with self._lock:
            if self._closed:
                return
            # with a group of its own it does not hear of Ctrl-C; it ends when the pipe is closed
            child = subprocess.Popen(
                [sys.executable, "-m", __name__, name],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            )
            self._children.add(child)
        status = child.wait()
        with self._lock:
            self._children.discard(child)
        child.stdin.close()
        log.debug("compiling %s in the background ended with status %d", name, status)

    def wait(self, name, tell=None):
        """
        Wait until a job has ended; at once where there is nothing to wait for.

        A job that failed is no error: its kernels are compiled when they are called.

        Parameters
        ----------
        name : str
            One of `JOBS`.
        tell : callable, optional
            Called with a sentence before waiting.
        """
        event = self._done.get(_check([name])[0])
        if event is None or event.is_set():
            return
        if tell is not None:
            _, what, seconds = JOBS[name]
            tell(f"compiling {what}, once for each installation, up to {seconds} s")
        event.wait()

    def close(self):
        """End what still runs."""
        with self._lock:
            self._closed = True
            for child in self._children:
                child.kill()

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.close()


def compile_in_background(jobs=None, *, n_processes=None):
    """
    Begin to compile, in processes beside this one, what is not compiled yet.

    Where all is compiled already no process is started and nothing heavy imported. The processes
    end with this one, however it ends.

    Parameters
    ----------
    jobs : iterable of str, optional
        Names of `JOBS`, first what is needed first; all if not given.
    n_processes : int, optional
        How many run at a time; as many as there are cores if not given.

    Returns
    -------
    handle : `CompileHandle`
        To wait for jobs, and to be closed.

    Raises
    ------
    ValueError
        If there is no such job, or ``n_processes`` is not positive.
    """
    names = _check(jobs)
    if n_processes is None:
        n_processes = os.cpu_count() or 1
    if n_processes < 1:
        raise argument_error("n_processes", "at least 1", n_processes)
    return CompileHandle(tuple(name for name in names if not is_compiled(name)), n_processes)


def _end_with_parent():
    """End this process when the pipe from the one that started it is closed."""
    sys.stdin.buffer.read()
    os._exit(1)


def _main():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    compile_job(sys.argv[1])
    # not through the end of the interpreter: the other thread holds stdin
    os._exit(0)


if __name__ == "__main__":
    _main()
