"""Light of sources in level-1b ramps, and the mosaics that are reduced from them."""

import dataclasses
from pathlib import Path

import numpy as np
from astropy.io import fits
from scipy.ndimage import binary_dilation

from miricigale.detector import InterpixelCapacitance, Ramp
from miricigale.injection.light import light_on_image
from miricigale.instrument import DQ
from miricigale.psf import miri_psf
from miricigale.reduction import RampFit, Reducer, reduce_files
from miricigale.reduction.references.detector_model import maps_of
from miricigale.reduction.results import rate_image
from miricigale.utils.arrays import quiet_division
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import open_fits
from miricigale.utils.options import check_data, check_that
from miricigale.utils.random import stream
from miricigale.utils.units import FNU

#: Electrons in an integration below which a pixel is left as it is.
_FAINTEST = 1e-3

#: Effects that the PSF holds: charge is shared between pixels after its Poisson noise.
_OPTICS = ("jitter", "cruciform", "pixel")

#: Largest number of a raw group.
_LARGEST = 65535

#: Steps of Newton's method, and the change (DN) that ends it.
_STEPS = 20
_EXACT = 1e-4


@dataclasses.dataclass(frozen=True)
class Exposures:
    """
    Ramps and how they are reduced.

    Parameters
    ----------
    paths : tuple of path-like
        Level-1b files of one filter.
    reducer : `~miricigale.reduction.Reducer`
        Settings of the reduction.
    pixel_scale : `~astropy.units.Quantity`
        Of the mosaic.
    align : str or None
        As for `~miricigale.reduction.reduce_files`.
    """

    paths: tuple
    reducer: Reducer
    pixel_scale: object
    align: object = None

    def reduce(self, folder, paths=None, n_threads=None, progress_bar=False):
        """
        Reduce the ramps, or others in their place, to one mosaic.

        Parameters
        ----------
        folder : path-like
            Of the products.
        paths : list of path-like, optional
            The files with injected sources.
        n_threads : int, optional
            Threads.
        progress_bar : bool, optional
            Whether progress is shown.

        Returns
        -------
        mosaic : `~pathlib.Path`

        Raises
        ------
        ValueError
            If a file cannot be reduced, or they are of several filters.
        """
        table = reduce_files(
            self.paths if paths is None else paths,
            folder,
            reducer=self.reducer.replace(n_threads=n_threads),
            pixel_scale=self.pixel_scale,
            align=self.align,
            progress_bar=progress_bar,
        )
        bad = table[~np.isin(table["status"], ["reduced", "kept"])]
        if len(bad):
            reason = f"{bad['file'][0]}: {bad['reason'][0] or bad['status'][0]}"
            raise argument_error("paths", "exposures that can be reduced", reason)
        mosaics = [name for name in table["file"] if str(name).startswith("mosaic_")]
        check_that(len(mosaics) == 1, "paths", "exposures of one filter", mosaics)
        return Path(folder) / str(mosaics[0])

    def injected(self, sources, seed, number, folder, n_threads=None):
        """
        Put sources into the ramps, and reduce these.

        Parameters
        ----------
        sources : `~astropy.table.QTable`
            ``sky``, ``profile``, shapes and ``flux``.
        seed, number : int
            Of the run and of the trial: streams of the photon noise.
        folder : path-like
            Of the ramps and the products.
        n_threads : int, optional
            Threads.

        Returns
        -------
        mosaic : `~pathlib.Path`
        """
        folder = Path(folder)
        paths = []
        for path in map(Path, self.paths):
            name = path.name.removesuffix(".gz")
            rng = stream(seed, "injected photons", number, name)
            paths.append(inject_file(path, folder / name, sources, self.reducer, rng, n_threads))
        return self.reduce(folder / "reduced", paths, n_threads)


def is_ramp(path):
    """Tell whether a file holds the groups of an exposure (its SCI has four dimensions)."""
    with open_fits(path, wanted="an image or a ramp") as hdus:
        return "SCI" in hdus and hdus["SCI"].header.get("NAXIS") == 4


def inject_file(path, output, sources, reducer, rng, n_threads=None):
    """
    Write a level-1b file with the light of sources.

    Parameters
    ----------
    path, output : path-like
        The file, and that with the sources, which has its keywords and all other extensions.
    sources, reducer, rng, n_threads
        As for `inject_ramp`.

    Returns
    -------
    output : path-like
    """
    ramp = Ramp.read(path)
    check_data(
        ramp.data.dtype == np.uint16 and not ramp.steps,
        path,
        "is not level 1b: sources are put into counts as they were read",
    )
    data = inject_ramp(ramp, sources, reducer, rng, n_threads)
    with fits.open(path, memmap=False) as hdus:
        hdus["SCI"].data = data
        hdus.writeto(output)
    return output


def inject_ramp(ramp, sources, reducer, rng, n_threads=None):
    """
    Add the light of sources to the counts of a ramp.

    Parameters
    ----------
    ramp : `~miricigale.detector.Ramp`
        Counts as they were read.
    sources : `~astropy.table.QTable`
        ``sky``, ``profile``, shapes and ``flux``.
    reducer : `~miricigale.reduction.Reducer`
        What the ramp is reduced with: its flat, conversion, gain and linearity are those of the injected light.
    rng : `~numpy.random.Generator`
        Of the photon noise.
    n_threads : int, optional
        Threads; they change nothing.

    Returns
    -------
    data : uint16 `~numpy.ndarray`, shape (n_int, n_group, ny, nx)
        Counts with the sources.

    Notes
    -----
    Surface brightness becomes DN/s by the inverse of the calibration and electrons by the gain; each group
    collects a Poisson number of them, of which neighbors share a part (interpixel capacitance); groups that are
    averaged on board (FASTGRPAVG) have the mean of their frames. Counts are made linear, the charge is added, and
    the inverse of the linearity brings them back. They are rounded at random, up or down in proportion, so that
    light of less than 1 DN is not lost; that adds at most 1/4 DN^2 to the variance of a group. Groups that reach
    saturation stay there. Persistence, and a brighter-fatter effect, are not drawn.
    """
    exposure = ramp.exposure
    maps = maps_of(reducer, ramp)
    psf = miri_psf(exposure.filter, includes=_OPTICS)
    light = light_on_image(
        sources, sources["flux"].to(FNU), exposure.wcs, exposure.shape, psf, n_threads
    )
    rate = _rate(light, ramp, reducer, maps)
    gain = np.broadcast_to(np.asarray(maps.gain, float), rate.shape)
    mean = np.where(np.isfinite(gain), rate * gain, 0.0) * ramp.group_time
    # no light falls on reference pixels, whose drift is subtracted from all others
    blind = (np.asarray(ramp.pixel_dq | maps.pixel_dq) & int(DQ.REFERENCE_PIXEL)) != 0
    mean = np.where(blind, 0.0, mean)
    n_group = ramp.shape[1]
    lit = mean * n_group > _FAINTEST
    kernel = np.ones((1, 1))
    if ramp.shows(InterpixelCapacitance) is not False:
        kernel = np.asarray(reducer.detector.ipc_kernel, float)
    reached = binary_dilation(lit, np.ones(kernel.shape))
    y, x = np.nonzero(reached & ~blind)
    data = ramp.data.copy()
    for k in range(ramp.shape[0]):
        electrons = _collected(mean, lit, y, x, kernel, n_group, exposure.n_frames, rng)
        added = electrons / gain[y, x][:, None]
        data[k][:, y, x] = _with_charge(data[k][:, y, x].T, added, maps, y, x, k, rng).T
    return data


def _rate(light, ramp, reducer, maps):
    """Return the slopes in DN/s of a surface brightness, (ny, nx); 0 where a slope has no brightness."""
    shape = light.shape
    plane = np.ones(shape, np.float32)
    none = np.zeros(shape, np.int16)
    jumps = np.zeros(0, np.int64)
    flags = np.zeros(shape, np.int64)
    fit = RampFit(plane, plane, plane, none + 1, none, flags, jumps)
    unit = reducer.calibrate(rate_image(reducer, ramp, maps, fit).image)
    brightness = np.asarray(unit.data, float)
    with quiet_division():
        rate = light / brightness
    return np.where(np.isfinite(rate) & (brightness > 0), rate, 0.0)


def _collected(mean, lit, y, x, kernel, n_group, n_frames, rng):
    """Electrons of each group, the mean of its frames, that pixels hold since the reset, shape (n, n_group)."""
    row, column = np.nonzero(lit)
    by_frame = rng.poisson(mean[lit][:, None] / n_frames, (len(row), n_group * n_frames))
    drawn = by_frame.cumsum(axis=1).reshape(len(row), n_group, n_frames).mean(axis=2)
    place = np.full(np.add(lit.shape, 2), -1)
    place[y + 1, x + 1] = np.arange(len(y))
    held = np.zeros((len(y), n_group))
    middle = kernel.shape[0] // 2
    for (i, j), share in np.ndenumerate(kernel):
        target = place[row + 1 + i - middle, column + 1 + j - middle]
        inside = target >= 0
        # of one neighbor each pixel has one
        held[target[inside]] += share * drawn[inside]
    return held


def _with_charge(raw, added, maps, y, x, integration, rng):
    """Return the raw counts (n, n_group) of pixels with linear DN added to them."""

    def at(values):
        values = np.asarray(values, float)
        if values.ndim == 2 and values.size > 1:
            return values[y, x][:, None]
        return values

    level = np.asarray(at(maps.bias), float)
    if maps.reset is not None:
        # of all further ones the last stands
        reset = np.nan_to_num(maps.reset[min(integration, len(maps.reset) - 1)][:, y, x].T)
        n = min(reset.shape[1], raw.shape[1])
        offsets = np.zeros(raw.shape)
        offsets[:, :n] = reset[:, :n]
        level = level + offsets
    coefficients = [at(plane) for plane in maps.linearity]
    counts = raw.astype(float)
    measured = counts - level
    saturation = np.broadcast_to(at(maps.saturation), raw.shape)
    target = _linear(measured, coefficients) + added
    with np.errstate(invalid="ignore", over="ignore"):
        full = np.isfinite(saturation) & (target >= _linear(saturation - level, coefficients))
    changed = _measured(np.where(full, measured, target), measured + added, coefficients)
    new = np.floor(counts + (changed - measured) + rng.uniform(size=raw.shape))
    new = np.where(full, np.maximum(counts, np.ceil(saturation)), new)
    # what is saturated already, or was not read, stays
    stays = (counts >= np.minimum(saturation, _LARGEST)) | (counts == 0) | ~np.isfinite(new)
    return np.where(stays, counts, np.clip(new, 0, _LARGEST)).astype(np.uint16)


def _linear(measured, coefficients):
    value = coefficients[-1] + np.zeros_like(measured)
    for coefficient in coefficients[-2::-1]:
        value = value * measured + coefficient
    return value


def _measured(target, start, coefficients):
    """Return the counts above the bias whose linear ones are ``target``, by Newton's method."""
    slopes = [k * coefficient for k, coefficient in enumerate(coefficients)][1:]
    measured = start.copy()
    for _ in range(_STEPS):
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step = (_linear(measured, coefficients) - target) / _linear(measured, slopes)
        step = np.where(np.isfinite(step), step, 0.0)
        measured -= step
        if np.max(np.abs(step), initial=0.0) < _EXACT:
            break
    return measured
