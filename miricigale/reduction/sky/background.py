"""Smooth background of an image, with the sources masked, and how far it can be trusted."""

import dataclasses

import numpy as np

from miricigale.instrument import DQ, ImageFacts
from miricigale.reduction.images.cells import cells_of, pixels_of
from miricigale.reduction.images.images import flag_pixels, plain_mask, sigma, with_data
from miricigale.reduction.sky.sky_mask import detect, grown, light_left
from miricigale.reduction.sky.sky_mesh import SkyMesh, sky_boxes
from miricigale.utils import sep_tools
from miricigale.utils.exceptions import ReductionWarning, warn
from miricigale.utils.options import check_choice, check_least, check_positive, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.tables import Flags
from miricigale.utils.values import value_class

# rounds of detecting and masking sources at most; it ends when the mask stays
_ROUNDS = 5
# least share of the pixels that is taken for sky
_LEAST_SKY = 0.05
# doubt of the level, in the noise of a pixel, from which it is told
_DOUBT = 0.5
# of the level itself, and in the noise of a pixel, above which a level is not known
_UNKNOWN = 1 / 3
_UNKNOWN_NOISE = 3.0
# pixels from which the median of a smooth image is taken
_SOME = 100_000


class BackgroundFlags(Flags):
    """
    Why a background cannot be trusted.

    Examples
    --------
    >>> from miricigale.reduction import BackgroundFlags
    >>> BackgroundFlags.names(BackgroundFlags.FEW_SKY | BackgroundFlags.CONFUSED)
    ['few_sky', 'confused']
    """

    GOOD = 0
    FEW_SKY = 1, "Sources leave less than a twentieth of the pixels: all were taken for sky."
    CONFUSED = (
        2,
        (
            "Light of sources that is not masked leaves the level open by more than half of the "
            "noise of a pixel: what is faint, blends, or is wide. The error says by how much."
        ),
    )
    UNKNOWN = (
        4,
        (
            "The level is open by more than a third of itself, and by more than three times the "
            "noise of a pixel: Reducer leaves the sky in the image."
        ),
    )


@value_class
class Background:
    """
    Smooth background of an image.

    Parameters
    ----------
    level, rms : `~numpy.ndarray` of float32, shape (ny, nx)
        Background, and the noise of a pixel about it, in the unit of the image.
    error : `~numpy.ndarray` of float32, shape (ny, nx)
        Standard error of the level: what the noise of the sky's pixels leaves open, and the light of
        sources that may be in it, in quadrature.
    source_mask : `~numpy.ndarray` of bool, shape (ny, nx)
        Pixels that were taken for sources; more than the level leaves out if they leave too little
        (``FEW_SKY``).
    box, filter_size : int
        Size of the boxes in pixels, and of the median filter in boxes.
    flags : `BackgroundFlags`
        Why it cannot be trusted; 0 where nothing speaks against it.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import north_up_wcs
    >>> field = SkyCoord(53, -27, unit="deg")
    >>> wcs = north_up_wcs(field, 0.11 * u.arcsec, (100, 100))
    >>> rng = np.random.default_rng(1)
    >>> error = StdDevUncertainty(np.full((100, 100), 0.1))
    >>> images = [
    ...     CCDData(
    ...         rng.normal(level, 0.1, (100, 100)),
    ...         unit="MJy/sr",
    ...         uncertainty=error,
    ...         wcs=wcs,
    ...     )
    ...     for level in (5.0, 5.2, 5.1)
    ... ]
    >>> from miricigale.reduction import estimate_background
    >>> background = estimate_background(images[0])
    >>> print(f"{np.median(background.level):.2f} MJy/sr, flags {background.flags}")
    5.00 MJy/sr, flags 0
    """

    level: np.ndarray
    rms: np.ndarray
    error: np.ndarray
    source_mask: np.ndarray
    box: int
    filter_size: int
    flags: BackgroundFlags = BackgroundFlags.GOOD

    @property
    def trusted(self):
        """Whether nothing speaks against it."""
        return not self.flags

    def __repr__(self):
        doubt = ""
        if not self.trusted:
            doubt = f", {', '.join(BackgroundFlags.names(self.flags))}"
        return (
            f"<Background median {np.median(self.level):.4g} +- {np.median(self.error):.2g}, rms "
            f"{np.median(self.rms):.4g}, {100 * self.source_mask.mean():.1f} % masked as sources{doubt}>"
        )


@takes_other_keywords
def estimate_background(image, *, method="masked", box=64, filter_size=3, plane=True, warn=True):
    """
    Estimate the background of an image, masking what stands above it.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        Any unit.
    method : {"masked", "sep", "none"}, optional
        ``"sep"`` is the plain mesh of sep, as in Yang et al. 2021 with ``box=32`` and ``filter_size=3``: sources
        are only clipped, and ``plane`` has no meaning; ``"none"`` is a level of 0.
    box, filter_size : int, optional
        Size of the boxes in pixels, and of the median filter in boxes.
    plane : bool, optional
        Whether a plane, or a parabola with twenty boxes or more, is taken off before the mesh of boxes.
    warn : bool, optional
        Whether there is a warning of a background that cannot be trusted.

    Returns
    -------
    background : `Background`

    Raises
    ------
    ValueError
        If an option is out of range or every pixel is masked.

    Warns
    -----
    `~miricigale.utils.exceptions.ReductionWarning`
        If it cannot be trusted; ``background.flags`` says why.

    Notes
    -----
    Sources are at least five connected pixels that rise by three sigma above the background after a
    Gaussian smoothing of 0.85 pixels, twenty after one of 2.5, for the wings of bright sources, and, for what is
    faint and wide, three cells of 4 x 4 pixels after one of 4, or twelve that rise by six sigma after one of 8.
    Sigma is that of the smoothed image, as measured.

    The mask of the sources is dilated by three pixels and the cells around them, and by a share of the local half
    width of what it covers, as far as half of the image is left. If less than a twentieth is left, the level is
    that of all pixels.

    A plane or parabola, fitted to the boxes, each at the mean place of its sky, is taken off first and given
    back: distortion bends a gradient of the sky. A box of which a mask or the edge leaves a part stands for its
    center all the same, and is off by what a gradient changes from there to the part; with ``plane=False`` that
    stays.

    Boxes that sources fill are filled from their neighbors. The level is the clipped median of the unmasked
    pixels; before any source is masked it is the mode as Source Extractor has it.

    Light of sources that is not masked makes it too bright. The darkest of 200 cells of 8 x 8 pixels is 2.6 sigma
    below the level in noise alone (the errors of the image, with ``meta["noise_correction"]``). If it is darker by
    D, the level is lowered by D, the less the closer D is to a tenth of the noise of a pixel or the fewer pixels
    sources cover. The error of the level is the quadratic sum of

    - the error of the median in the noise of the pixels,
    - D, or the excess of the cells' variance over the noise, if that is seen beyond chance,
    - half of what masking sources changes of the median, for their wings and for fainter ones, and where they
      cover much of the image the structure of the mesh: 2.5 times the square of their share, times what the
      level is above its darkest places.

    How often that holds is measured on the page of the reduction's accuracy.

    In mosaics of pixels so small that several share their noise (``meta["noise_correction"]`` of 2 and more)
    sources are searched for in means of as many by as many of them, which are the pixels of these options
    then, but for the boxes.

    References
    ----------
    Detection in tiers of smoothing, from wide to narrow, follows Bagley et al. 2023, ApJL 946, L12, sec. 3.
    Noise of faint sources in the distribution of brightness: Scheuer 1957, Proc. Camb. Phil. Soc. 53, 764; Condon
    1974, ApJ 188, 279.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import north_up_wcs
    >>> field = SkyCoord(53, -27, unit="deg")
    >>> wcs = north_up_wcs(field, 0.11 * u.arcsec, (100, 100))
    >>> rng = np.random.default_rng(1)
    >>> error = StdDevUncertainty(np.full((100, 100), 0.1))
    >>> images = [
    ...     CCDData(
    ...         rng.normal(level, 0.1, (100, 100)),
    ...         unit="MJy/sr",
    ...         uncertainty=error,
    ...         wcs=wcs,
    ...     )
    ...     for level in (5.0, 5.2, 5.1)
    ... ]
    >>> from miricigale.reduction import estimate_background
    >>> estimate_background(images[0], box=32)
    <Background median 4.999 +- 0.0016, rms 0.1002, 0.3 % masked as sources>
    """
    check_choice(method, "method", ("masked", "sep", "none"))
    if method == "none":
        return known_background(np.zeros(image.shape, np.float32))
    check_least(box, "box", 4, whole=True)
    check_least(filter_size, "filter_size", 1, whole=True)
    mask = plain_mask(image)
    check_that(not mask.all(), "image", "one with pixels that are not masked", "every pixel masked")
    data = sep_tools.native(image.data)
    data = np.where(mask, 0, data if data.dtype.kind == "f" else data.astype(float))
    correlation = ImageFacts.of(image).noise_correction
    if method == "sep":
        background = _sep_background(data, mask, int(box), int(filter_size), correlation)
    else:
        noise_map = _error_map(image, mask)
        mesh = (int(box), int(filter_size), plane)
        background = _masked(data, mask, noise_map, mesh, correlation)
    if warn:
        warn_of(background, mask, image.unit)
    return background


def known_background(level):
    """Return the `Background` of a level of which nothing else is known."""
    unknown = np.broadcast_to(np.float32(np.nan), level.shape)
    return Background(level, unknown, unknown, np.broadcast_to(False, level.shape), 1, 1)


def subtractable(background):
    """Return the `Background` to take off: a level of 0 where the level of the sky is not known."""
    if BackgroundFlags.UNKNOWN not in background.flags:
        return background
    return dataclasses.replace(background, level=np.zeros_like(background.level))


def _masked(data, mask, noise_map, mesh, correlation):
    """Background with the sources masked; ``mesh`` has the size of the boxes, the filter and the plane."""
    box, filter_size, plane = mesh
    # pixels along each axis that share their noise, as far as boxes have four such groups of them
    step = max(1, min(int(correlation), box // 4))
    # without a plane what a gradient leaves at edges would be taken for sources, the more with each round
    if step == 1:
        mesh, sources_mask, flags = _search(SkyMesh(data, mask, box, filter_size, True), noise_map)
        sources = mesh.sources
    else:
        mean, small, coarse_noise = _averaged(data, mask, noise_map, step, correlation)
        mesh = SkyMesh(mean, small, box // step, filter_size, True)
        mesh, sources_mask, flags = _search(mesh, coarse_noise)
        sources_mask = pixels_of(sources_mask, data.shape, step) & ~mask
        sources = pixels_of(mesh.sources, data.shape, step) & ~mask
    if step > 1 or not plane:
        if flags and not sources.any():
            sources = None
        mesh = SkyMesh(data, mask, box, filter_size, plane, sources)
    if noise_map is None:
        noise = mesh.rms
    else:
        noise = np.where(noise_map[1], noise_map[0], mesh.rms)
    # an image without any has that of its numbers
    noise = np.maximum(noise, np.float32(1e-6 * np.abs(mesh.level).max() or 1))
    shift, dark, light = light_left(mesh, sources_mask, noise * np.float32(correlation), step)
    if shift + np.median(_thinned(light)) > _DOUBT * np.median(_thinned(noise)):
        flags |= BackgroundFlags.CONFUSED
    error = np.sqrt((mesh.error * np.float32(correlation)) ** 2 + dark**2 + light**2)
    level = mesh.level - shift
    if _is_unknown(level, error, noise):
        flags |= BackgroundFlags.UNKNOWN
    return Background(level, mesh.rms, error, sources_mask, mesh.box, mesh.filter_size, flags)


def _is_unknown(level, error, noise):
    """Tell whether the level of the sky is too uncertain to be taken off."""
    brightness = abs(np.median(_thinned(level)))
    pixel_noise = np.median(_thinned(noise))
    # the sky is off already: its share of the error says nothing, and what is taken off changes nothing
    if brightness < pixel_noise:
        return False
    limit = max(_UNKNOWN * brightness, _UNKNOWN_NOISE * pixel_noise)
    return np.median(_thinned(error)) > limit


def _search(mesh, noise_map):
    """Return the mesh of what sources leave, mask of all that were found, and whether they leave enough."""
    mask = mesh.mask
    sources = mesh.sources
    for _ in range(_ROUNDS):
        noise = _noise(noise_map, mesh.rms, mask | sources)
        sources = grown(detect(mesh.residual, noise, mask, sources), mask)
        if np.count_nonzero(~sources & ~mask) < _LEAST_SKY * np.count_nonzero(~mask):
            return mesh, sources, BackgroundFlags.FEW_SKY
        # what one pixel in a thousand changes is less than the noise
        if np.count_nonzero(sources ^ mesh.sources) <= 1e-3 * sources.size:
            break
        mesh = mesh.measured(sources)
    return mesh, mesh.sources, BackgroundFlags.GOOD


def _averaged(data, mask, noise_map, step, correlation):
    """Return the means over pixels that share their noise, their mask, and what `_stated` says of them."""
    mean, share = cells_of(data, ~mask, step)
    small = share < 0.5
    if noise_map is not None:
        error, part = cells_of(*noise_map, step)
        noise_map = error * np.float32(correlation / step), ~small & (part > 0)
    return np.where(small, 0, mean), small, noise_map


def _error_map(image, mask):
    """Return the errors of an image, and where it has them; None without any."""
    if image.uncertainty is None:
        return None
    error = sigma(image)
    # files have errors of 0 where they have none
    return error, ~mask & (error > 0) & np.isfinite(error)


def _thinned(values):
    """Return every so many rows and columns of a large image."""
    step = max(1, int(np.sqrt(values.size / _SOME)))
    return values[::step, ::step]


def _noise(noise_map, rms, mask):
    """Return the noise about the mesh, larger where the errors are: no mesh follows the seams of mosaics."""
    if noise_map is None or not (sampled := _thinned(noise_map[1] & ~mask)).any():
        return rms
    scale = np.median(_thinned(rms)[sampled] / _thinned(noise_map[0])[sampled])
    return np.fmax(rms, noise_map[0] * np.float32(scale))


def warn_of(background, mask, unit):
    """Warn of a background, in a unit, that cannot be trusted."""
    if background.trusted:
        return
    good = ~mask
    reasons = " ".join(BackgroundFlags.meanings()[flag.value][1] for flag in background.flags)
    level = np.median(background.level[good])
    error = np.median(background.error[good])
    share = 100 * background.source_mask[good].mean()
    warn(
        f"the background of {level:.4g} cannot be trusted to better than {error:.2g} {unit} "
        f"({share:.0f} % of the pixels are sources): {reasons}",
        ReductionWarning,
    )


def _sep_background(data, mask, box, filter_size, correlation):
    """Return the mesh of sep as it is."""
    level, rms = sep_tools.background(data, mask, box, filter_size)
    # sep takes boxes of which half is left, and gives 0 and 1 where there is none
    enough = (sky_boxes(data, mask, box).share >= 0.5).any()
    if enough:
        flags = BackgroundFlags.GOOD
    else:
        flags = BackgroundFlags.FEW_SKY
    error = rms * (2.14 * correlation * min(1.0, 1.2533 / filter_size) / box)
    level = level.astype(np.float32, copy=False)
    rms = rms.astype(np.float32, copy=False)
    error = error.astype(np.float32, copy=False)
    return Background(level, rms, error, np.zeros(mask.shape, bool), box, filter_size, flags)


@takes_other_keywords
def remove_background(image, background, *, negative_threshold=10.0, negative_noise="larger"):
    """
    Take a background off an image and mask what lies far below it.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        Any unit.
    background : `Background`
        Of the image.
    negative_threshold : float or None, optional
        Pixels below the background by more than this many sigma are masked with
        `DQ.NEGATIVE`; None for none.
    negative_noise : {"larger", "background"}, optional
        Whose sigma that is: the larger of the pixel's error and the noise about the background, so
        that pixels that are known to be noisy stay; or the latter alone, as in Yang et al. 2021.

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        Without background; ``meta["background"]`` is the median that was taken off, ``background_error`` that of
        its errors, where they are known, ``background_flags`` the names of its flags, and ``n_negative`` how many
        pixels were masked, if they were searched for.

    Raises
    ------
    ValueError
        If an option is out of range, or the errors are asked for and the image has none.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import north_up_wcs
    >>> field = SkyCoord(53, -27, unit="deg")
    >>> wcs = north_up_wcs(field, 0.11 * u.arcsec, (100, 100))
    >>> rng = np.random.default_rng(1)
    >>> error = StdDevUncertainty(np.full((100, 100), 0.1))
    >>> images = [
    ...     CCDData(
    ...         rng.normal(level, 0.1, (100, 100)),
    ...         unit="MJy/sr",
    ...         uncertainty=error,
    ...         wcs=wcs,
    ...     )
    ...     for level in (5.0, 5.2, 5.1)
    ... ]
    >>> from miricigale.reduction import estimate_background, remove_background
    >>> image = remove_background(images[0], estimate_background(images[0]))
    >>> print(f"{image.meta['background']:.2f} MJy/sr")
    5.00 MJy/sr
    """
    check_choice(negative_noise, "negative_noise", ("larger", "background"))
    check_positive(negative_threshold, "negative_threshold", optional=True)
    good = ~plain_mask(image)
    error = background.error
    entries = {}
    if np.isfinite(error).all():
        entries = {"background_error": float(np.median(error[good]))}
    out = with_data(
        image,
        np.asarray(image.data, np.float32) - background.level,
        background=float(np.median(background.level[good])),
        background_flags=BackgroundFlags.names(background.flags),
        **entries,
    )
    if negative_threshold is not None:
        noise = background.rms
        if negative_noise == "larger":
            noise = np.fmax(noise, sigma(image))
        low = ~plain_mask(out) & (out.data < -negative_threshold * noise)
        out = flag_pixels(out, low, DQ.NEGATIVE | DQ.DO_NOT_USE)
        out.meta["n_negative"] = int(np.count_nonzero(low))
    return out
