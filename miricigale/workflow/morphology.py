"""Galaxies beyond Sersic profiles: clumps, and stamps of an image of real galaxies."""

import dataclasses
import functools
import logging

import astropy.units as u
import numpy as np
from astropy.nddata import CCDData
from astropy.table import QTable, Table, vstack
from scipy.ndimage import find_objects

from miricigale import photometry
from miricigale.instrument.sky_axes import grid_angle
from miricigale.photometry.commands.kernel_files import image_psf
from miricigale.photometry.images.arrays import nearest_values, pixel_scale
from miricigale.profiles import sersic_radius
from miricigale.psf import psf_image, rotate_psf
from miricigale.scene import CatalogFlags, Cutout, check_catalog, deconvolve
from miricigale.utils.exceptions import DataError
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import without_none
from miricigale.utils.random import stream
from miricigale.utils.store import open_parts, write_parts
from miricigale.utils.units import ANGLE
from miricigale.utils.values import value_class

log = logging.getLogger(__name__)

#: Clumps in a galaxy, least and largest number.
CLUMPS = (3, 12)
#: Slope of the number of clumps by light, dN/dL ~ L^-slope, and largest over least light (Dessauges-Zavadsky &
#: Adamo 2018, MNRAS 479, L118, masses of clumps).
SLOPE = 1.7
LIGHT_RANGE = 30.0
#: Share of a profile's light within which clumps lie.
CLUMPS_WITHIN = 0.9
#: Largest Sersic index of galaxies that have clumps.
CLUMPY_INDEX = 2.5

#: Least signal-to-noise of stamps.
MIN_SNR = 50.0
#: Least half-light radius (arcsec) of stamps where galaxies are drawn, above the pixel of MIRI.
MIN_RADIUS = 0.15
#: Range of factors on their size.
SIZE_FACTORS = (0.5, 2.0)
#: Width of a PSF's array (arcsec).
_PSF_WIDTH = 10.0
#: Rim of a deconvolved image in which no galaxy is used (arcsec).
_RIM = 1.0
#: Detection: in sigma, above the noise that would join galaxies; and the least share of the light of a part that
#: is taken for another galaxy, so that clumps stay.
DETECTION = {
    "preset": dataclasses.replace(photometry.DETECTION_PRESETS["default"], contrast=0.1),
    "threshold": 2.0,
    "stated_on": 0.06 * u.arcsec,
    "dilation": "area",
}
#: Galaxies of the most similar axis ratio out of which one is drawn.
N_LIKE = 5
_LAYOUT = "miricigale stamps 1"


def _sersic(catalog):
    """Tell which sources of a checked catalog are painted as Sersic profiles."""
    unusable = np.asarray(catalog["flags"]) & int(CatalogFlags.unusable_profile())
    return (np.asarray(catalog["profile"]) == "sersic") & (unusable == 0)


def add_clumps(catalog, filter, *, share, seed, point=None):
    """
    Put a share of the light of disks into clumps: points at places drawn from their profiles.

    These are made up, by the constants of this module: 3 to 12 clumps in each Sersic profile of an
    index up to 2.5, their light drawn from a power law, their radii evenly in the light that the profile
    encloses (up to 90 % of it), so that they follow the profile. Each galaxy has its own random stream: its clumps
    are alike in all bands.

    Parameters
    ----------
    catalog : `~astropy.table.QTable`
        As for `~miricigale.scene.Scene`; it is not changed.
    filter : str
        The flux column.
    share : float
        Share of the light of a galaxy that is in its clumps.
    seed : int
        Seed of the draws.
    point : str, optional
        Column with the share of the flux that is in a point at the center: clumps take nothing of it.

    Returns
    -------
    catalog : `~astropy.table.QTable`
        The clumps are further rows, after those of the catalog, with ids of their own.

    References
    ----------
    Wuyts et al. 2012, ApJ 753, 114 (up to 20 % of the star formation in clumps off the centers).
    """
    checked = check_catalog(catalog, filters=[filter])
    clumpy = _sersic(checked) & (checked["sersic_index"] <= CLUMPY_INDEX)
    rows = np.flatnonzero(clumpy)
    if rows.size == 0:
        return catalog
    drawn = [_clumps(checked[row], seed) for row in rows]
    owner = np.repeat(rows, [len(light) for light, _, _ in drawn])
    light, east, north = map(np.concatenate, zip(*drawn, strict=True))
    flux = catalog[filter]
    inner = np.zeros(len(catalog))
    if point:
        inner = np.nan_to_num(np.asarray(catalog[point], float))
    clumped = np.where(clumpy, share * (1 - inner), 0.0)
    smooth = catalog.copy()
    clumps = catalog[owner]
    smooth[filter] = flux * (1 - clumped)
    clumps["id"] = _new_ids(np.asarray(catalog["id"]), owner)
    clumps["profile"] = np.full(len(owner), "point")
    clumps["sky"] = catalog["sky"][owner].spherical_offsets_by(east * ANGLE, north * ANGLE)
    clumps[filter] = flux[owner] * clumped[owner] * light
    if point:
        # the same light in the point
        smooth[point] = inner / (1 - clumped)
        clumps[point] = np.zeros(len(owner))
    return vstack([smooth, clumps], metadata_conflicts="silent")


def _new_ids(ids, owner):
    """Return ids that no source has: numbers above all, or the owner's text with a number."""
    number = np.arange(len(owner))
    if ids.dtype.kind in "iu":
        return ids.max() + 1 + number
    return np.array([f"{ids[row]} clump {k}" for k, row in enumerate(owner)])


def _clumps(row, seed):
    """Draw shares of the light, which add up to 1, and offsets to the east and north (arcsec)."""
    rng = stream(seed, "perturb", "clumps", str(row["id"]))
    n = int(rng.integers(CLUMPS[0], CLUMPS[1] + 1))
    # the inverse of the enclosed number of a power law from 1 to LIGHT_RANGE
    power = 1 - SLOPE
    light = (1 + rng.uniform(size=n) * (LIGHT_RANGE**power - 1)) ** (1 / power)
    radius = sersic_radius(rng.uniform(0, CLUMPS_WITHIN, n), row["sersic_index"])
    radius = radius * row["half_light_radius"].to_value(ANGLE)
    angle = rng.uniform(0, 2 * np.pi, n)
    # along the axes of the galaxy, then turned to its position angle
    major = radius * np.cos(angle)
    minor = radius * np.sin(angle) * row["axis_ratio"]
    turn = np.nan_to_num(row["position_angle"].to_value(u.rad))
    east = major * np.sin(turn) + minor * np.cos(turn)
    north = major * np.cos(turn) - minor * np.sin(turn)
    return light / light.sum(), east, north


@value_class
class RealGalaxies:
    """
    Galaxies that are found on an image, with the light that is theirs.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        MJy/sr with WCS, background subtracted, on which they are found.
    psf : `~miricigale.psf.InstrumentPSF`, optional
        Its PSF in the frame of the image, which is taken out of the stamps (`~miricigale.scene.deconvolve`).
        They are left as they are without it.
    """

    image: CCDData
    psf: object = None

    @classmethod
    def read(cls, path, *, psf=None):
        """
        Read an image of any origin.

        Parameters
        ----------
        path : path-like
            As for `~miricigale.photometry.read_mosaic`.
        psf : path-like, optional
            Image of its PSF, ``file.fits[EXTENSION,PLANE]`` of a cube. By default the model of its filter, if the
            header names one of which there is a model.

        Returns
        -------
        galaxies : `RealGalaxies`
        """
        file = photometry.MosaicFile(path, psf=psf)
        model = image_psf(file, argument="cutouts_psf")
        if model is None:
            log.warning("%s: no PSF is known, and none is taken out of its galaxies", path)
        else:
            angle = grid_angle(file.header.wcs, file.header.shape)
            model = rotate_psf(model, grid_angle=angle)
        return cls(file.read(), model)

    @functools.cached_property
    def _detections(self):
        """Light before the PSF, labels, detections, pixels that may be used and boxes of the labels."""
        segments, table = photometry.detect_sources(self.image, **DETECTION)
        usable = np.isfinite(self.image.data)
        if self.image.mask is not None:
            usable &= ~np.asarray(self.image.mask, bool)
        data = np.where(usable, self.image.data, 0.0)
        rim = 1
        if self.psf is not None:
            scale = pixel_scale(self.image.wcs)
            half = int(np.ceil(0.5 * _PSF_WIDTH / scale))
            array = psf_image(self.psf, pixel_scale=scale * ANGLE, shape=2 * half + 1)
            data = deconvolve(data, array)
            rim = int(np.ceil(_RIM / scale))
        # what lies beyond the edges is not known
        usable[:rim] = False
        usable[-rim:] = False
        usable[:, :rim] = False
        usable[:, -rim:] = False
        labels = np.asarray(segments.data)
        return data, labels, table, usable, find_objects(labels)

    def cutout(self, label, position=None):
        """
        Return the stamp of a detection: its own segment, all else is 0.

        Parameters
        ----------
        label : int
            Label of its segment.
        position : `~astropy.coordinates.SkyCoord`, optional
            What of it stands at the catalog's position; the center of its light by default.

        Returns
        -------
        cutout : `~miricigale.scene.Cutout` or None
            None where its signal-to-noise is below 50, or a pixel of it is masked or near the edge.
        """
        data, labels, table, usable, boxes = self._detections
        box = boxes[label - 1]
        segment = labels[box] == label
        if not (table["snr"][label - 1] >= MIN_SNR and np.all(usable[box][segment])):
            return None
        light = np.where(segment, data[box], 0.0)
        total = light.sum()
        if not total > 0:
            return None
        wcs = self.image.wcs[box]
        if position is None:
            y, x = np.indices(light.shape)
            x_center = float(np.sum(light * x) / total)
            y_center = float(np.sum(light * y) / total)
            position = wcs.pixel_to_world(x_center, y_center)
        return Cutout.from_image(CCDData(light, unit=self.image.unit, wcs=wcs), position)

    @property
    def labels(self):
        """Labels of all sources of the image, from 1."""
        return range(1, len(self._detections[2]) + 1)

    @functools.cached_property
    def resolved(self):
        """
        All galaxies that are wider than points.

        A table with ``stamp``, ``radius`` (arcsec, with half of the light), ``axis_ratio`` and
        ``major_axis``, the angle (deg) of the major axis from +y of the stamp, counter-clockwise.
        """
        columns = {"stamp": [], "radius": [], "axis_ratio": [], "major_axis": []}
        for label in self.labels:
            stamp = self.cutout(label)
            if stamp is None or not stamp.half_light_radius.value >= MIN_RADIUS:
                continue
            ratio, angle = _shape(stamp)
            columns["stamp"].append(stamp)
            columns["radius"].append(stamp.half_light_radius.value)
            columns["axis_ratio"].append(ratio)
            columns["major_axis"].append(angle)
        return Table(columns)


def _shape(stamp):
    """Return axis ratio and angle of the major axis, by the second moments within two half-light radii."""
    y, x = np.indices(stamp.data.shape)
    x = x - stamp.center[0]
    y = y - stamp.center[1]
    inner = np.hypot(x, y) <= 2 * (stamp.half_light_radius / stamp.pixel_scale).value
    light = np.where(inner, stamp.data, 0.0)
    xx = float(np.sum(light * x * x))
    yy = float(np.sum(light * y * y))
    xy = float(np.sum(light * x * y))
    values, axes = np.linalg.eigh([[xx, xy], [xy, yy]])
    # noise can make the smaller one negative
    ratio = np.sqrt(max(values[0], 0.01 * values[1]) / values[1])
    return float(ratio), float(np.degrees(np.arctan2(-axes[0, 1], axes[1, 1])))


def stamps_of_sources(catalog, galaxies, *, of, seed):
    """
    Return stamps of the sources of a catalog that are Sersic profiles.

    Parameters
    ----------
    catalog : `~astropy.table.QTable`
        As for `~miricigale.scene.Scene`.
    galaxies : `RealGalaxies`
        Those of the image.
    of : {"own", "any"}
        ``"own"``: the galaxy of the image at the place of the source, if no other source is in its segment.
        ``"any"``: one drawn for each source, by its id, out of the five most like it in axis ratio of those whose
        half-light radius becomes that of the source by a factor of 0.5 to 2 on its size; its major axis is put on
        that of the source, and its noise and what is left of the PSF are scaled with it.
    seed : int
        Seed of the draws.

    Returns
    -------
    stamps : dict of int or str to `~miricigale.scene.Cutout`
        By id. Sources without one keep their profile.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If no source has one.
    """
    checked = check_catalog(catalog)
    rows = np.flatnonzero(_sersic(checked))
    ids = np.asarray(checked["id"]).tolist()
    stamps = {}
    if of == "own":
        xy = np.stack(galaxies.image.wcs.world_to_pixel(checked["sky"]), axis=-1)
        labels = nearest_values(galaxies._detections[1], xy)[0]
        # of all sources, points too
        counts = np.bincount(labels)
        for row in rows:
            label = labels[row]
            if label and counts[label] == 1:
                stamps[ids[row]] = galaxies.cutout(label, checked["sky"][row])
    else:
        for row in rows:
            stamps[ids[row]] = _drawn(checked[row], galaxies, seed)
    stamps = without_none(stamps)
    if not stamps:
        msg = (
            f"none of the {len(rows)} Sersic profiles of the catalog has a galaxy on the image of [perturb] "
            f"cutouts (signal-to-noise of {MIN_SNR:g}, away from edges and masked pixels)"
        )
        raise DataError(msg)
    log.info("%d of %d Sersic profiles have the light of real galaxies", len(stamps), len(rows))
    return stamps


def _drawn(row, galaxies, seed):
    """Return the stamp of a galaxy drawn for a source, scaled and turned; None if none is like it."""
    galaxy = galaxies.resolved
    radius = row["half_light_radius"].to_value(ANGLE) * np.sqrt(row["axis_ratio"])
    factors = radius / floats(galaxy["radius"])
    like = np.flatnonzero((factors >= SIZE_FACTORS[0]) & (factors <= SIZE_FACTORS[1]))
    if like.size == 0:
        return None
    rng = stream(seed, "perturb", "cutouts", str(row["id"]))
    difference = np.abs(np.asarray(galaxy["axis_ratio"][like], float) - row["axis_ratio"])
    chosen = rng.choice(like[np.argsort(difference, kind="stable")[:N_LIKE]])
    stamp = galaxy["stamp"][chosen]
    turn = float(rng.choice([0.0, 180.0]))
    angle = np.nan_to_num(row["position_angle"].to_value(u.deg)) - galaxy["major_axis"][chosen]
    scale = stamp.pixel_scale * factors[chosen]
    return dataclasses.replace(stamp, pixel_scale=scale, angle=(angle + turn) * u.deg)


def write_stamps(stamps, path):
    """Write stamps by id to a FITS file, in single precision."""
    pieces = stamps.values()
    table = QTable({"id": list(stamps)})
    table["ny"], table["nx"] = np.transpose([stamp.data.shape for stamp in pieces])
    table["x"], table["y"] = np.transpose([stamp.center for stamp in pieces])
    table["pixel_scale"] = u.Quantity([stamp.pixel_scale for stamp in pieces])
    table["angle"] = u.Quantity([stamp.angle for stamp in pieces])
    light = np.concatenate([stamp.data.ravel() for stamp in pieces])
    write_parts(
        path,
        _LAYOUT,
        arrays={"light": light.astype(np.float32)},
        tables={"stamps": table},
        overwrite=True,
    )


def read_stamps(path):
    """Read stamps by id from a file of `write_stamps`."""
    with open_parts(path, (_LAYOUT,), wanted="stamps of galaxies") as parts:
        table = parts.table("stamps", QTable)
        light = parts.array("light")
    pieces = np.split(light, np.cumsum(table["ny"] * table["nx"])[:-1])
    stamps = {}
    for key, row, piece in zip(table["id"].tolist(), table, pieces, strict=True):
        stamps[key] = Cutout(
            piece.reshape(row["ny"], row["nx"]),
            center=(float(row["x"]), float(row["y"])),
            pixel_scale=row["pixel_scale"],
            angle=row["angle"],
        )
    return stamps
