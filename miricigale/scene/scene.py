"""A noiseless image of a catalog of sources, and the truth that belongs to it."""

import functools
from operator import attrgetter

import astropy.units as u
import numpy as np

from miricigale.depth import sky_background
from miricigale.filters.band_names import find_filter
from miricigale.filters.band_table import BandTable
from miricigale.instrument import Exposure, aperture, pixel_area_map
from miricigale.instrument.header_wcs import as_wcs
from miricigale.instrument.image import Image
from miricigale.profiles import ellipse_to_pixels
from miricigale.psf import InstrumentPSF, PSFGrid, as_psf, miri_psf
from miricigale.refdata import resources
from miricigale.scene.background import Background
from miricigale.scene.catalog import CatalogFlags, as_sources, check_catalog
from miricigale.scene.catalog_files import read_catalog
from miricigale.scene.cutouts import Cutout
from miricigale.scene.render import Painter
from miricigale.scene.sky import local_jacobian, pixel_positions
from miricigale.utils.arrays import is_inside
from miricigale.utils.exceptions import CatalogWarning, argument_error, warn
from miricigale.utils.interactive import WithTable
from miricigale.utils.meta import provenance
from miricigale.utils.missing_values import plain_floats
from miricigale.utils.options import check_kind, check_that, check_type
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.package_tables import column_texts
from miricigale.utils.positions import middle_pixel
from miricigale.utils.tables import Flags, described_columns
from miricigale.utils.units import ANGLE, FNU, SURFACE_BRIGHTNESS, own_unit, positive, to_array

#: PSFs with known pixel, frame and filter.
_TYPED = (InstrumentPSF, PSFGrid)

#: uJy per sr in MJy per sr.
_UJY_TO_MJY = 1e-12


class SceneFlags(Flags):
    """
    What happened to a source on its way into an image.

    Examples
    --------
    >>> from miricigale.scene import SceneFlags
    >>> SceneFlags.names(SceneFlags.CUT_PROFILE)
    ['cut_profile']
    """

    OUTSIDE_IMAGE = 1, "its center is on no pixel"
    NEAR_EDGE = 2, "its center is on the image, but less than 95 % of its painted light"
    CUT_PROFILE = 4, "more than 1 % of its light lies beyond the isophote where it was cut"
    NO_FLUX = 8, "its flux is not finite or negative: not painted"
    DRAWN_AS_POINT = 16, "a Sersic profile whose parameters cannot be used"


class Scene(WithTable):
    """
    A catalog of sources as an instrument would see it without noise.

    Parameters
    ----------
    catalog : `~astropy.table.Table`, dict, `pandas.DataFrame`, str or path-like
        Sources with positions (``sky``, or ``ra`` and ``dec``) and the fluxes of ``filter``, under any usual
        name of the band or as ``flux``: enough for points. All columns are those of
        `~miricigale.scene.check_catalog`. Text is a bundled catalog (``"catalog.goodss"``) or a file.
    exposure : `~miricigale.instrument.Exposure`, optional
        What the image is exposed by: gives ``filter`` and ``wcs``.
    filter : str or `~miricigale.filters.Filter`, optional
        Any name of the filter of the fluxes, such as ``"F770W"``.
    wcs : `~astropy.wcs.WCS`, `~astropy.io.fits.Header` or image, optional
        World coordinates of the image with their ``pixel_shape``, distorted or not: as such, or those of a header
        or of another image.
    psf : `~photutils.psf.ImagePSF`, `~photutils.psf.GriddedPSFModel` or other, optional
        PSF on the image's pixels with the pixel response in it (see `~miricigale.psf.as_psf`), or PSFs over
        the field (see `~miricigale.psf.miri_psf_grid`); `~miricigale.psf.miri_psf` by default. The pixel of an
        `~miricigale.psf.InstrumentPSF` or a `~miricigale.psf.PSFGrid` and, in the frame of the
        sky, its angle are compared with the WCS; its filter, if it has one, must be ``filter``,
        and the sub-array of a grid have the image's shape.
    background : `~miricigale.scene.Background`, `~astropy.units.Quantity` or str, optional
        Background, or its constant level, or how bright the zodiacal light is, as for
        `~miricigale.depth.sky_background` (``"low"``); none by default.
    enclosed : float, optional
        Sersic profiles are painted to the isophote that holds this fraction.
    max_radius : `~astropy.units.Quantity`, optional
        Largest semi-major axis of that isophote.
    n_threads : int, optional
        Threads of the Fourier transforms and kernels; as many as there are processors if not
        given. The image does not depend on it.
    cutouts : dict, optional
        For each id whose profile is ``"cutout"`` its `~miricigale.scene.Cutout`.
    agn : str, optional
        Column of the catalog that gives a source a point source at its center besides its
        profile: a flux comes on top of the column ``filter``; a number without unit, 0 to 1,
        is the share of the column ``filter`` that is in the point. NaN means none.
    units : dict of str to unit-like, or unit-like, optional
        Units of columns of the catalog that have none, such as those of a `pandas.DataFrame`, by their names
        (``{"F770W": "uJy", "re": "arcsec"}``); or that of the fluxes alone, such as ``"ABmag"``.

    Raises
    ------
    `~astropy.units.UnitsError`
        If fluxes, radii or angles have no unit, or a wrong one.
    ValueError
        If the WCS has no shape, the PSF belongs to other pixels or another filter, a cutout
        is missing or has no source, or a value of ``agn`` is out of its range.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        If fluxes are NaN, infinite or negative, with the number of each: such sources are not
        painted, and flagged in the truth.

    Notes
    -----
    Positions, sizes and angles go through the local Jacobian of the WCS. All sources are
    painted on one grid with the oversampling of the PSF and convolved once. Fluxes are
    conserved: ``sum(brightness * pixel area)`` of the image less its background is the sum
    of ``flux_in_image`` of the truth.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale import Exposure
    >>> from miricigale.scene import Scene
    >>> exposure = Exposure("F770W", n_groups=50, subarray="SUB64", pointing="53 -27")
    >>> star = {"id": [1], "ra": [53], "dec": [-27], "profile": ["point"]}
    >>> star["F770W"] = [20] * u.uJy
    >>> scene = Scene(star, exposure, background="low")
    >>> scene
    <Scene miri.f770w: 1 sources on 72 x 64 pixels>
    >>> print(f"{scene.truth['flux_in_image'][0]:.1f}")
    18.9 uJy
    """

    _parts = ("exposure",)

    @takes_other_keywords
    def __init__(
        self,
        catalog,
        exposure=None,
        *,
        filter=None,
        wcs=None,
        psf=None,
        background=None,
        enclosed=0.9995,
        max_radius=12 * u.arcsec,
        n_threads=None,
        cutouts=None,
        agn=None,
        units=None,
    ):
        self._arguments = {
            "catalog": catalog, "exposure": exposure, "filter": filter, "wcs": wcs, "psf": psf,
            "background": background, "enclosed": enclosed, "max_radius": max_radius,
            "n_threads": n_threads, "cutouts": cutouts, "agn": agn, "units": units,
        }  # fmt: skip
        if exposure is not None:
            check_kind(exposure, "exposure", Exposure)
            exposure.check_sky()
            filter = exposure.filter if filter is None else filter
            wcs = exposure.wcs if wcs is None else wcs
        example = "Scene(catalog, Exposure('F770W', 1000 * u.s, pointing='53.1 -27.8'))"
        check_that(filter is not None, "filter", f"given, or an exposure: {example}", "None")
        wanted = (
            "given, or an exposure (instrument.north_up_wcs makes one of center, scale and shape)"
        )
        check_that(wcs is not None, "wcs", wanted, "None")
        wcs = as_wcs(wcs)
        check_that(wcs.pixel_shape is not None, "wcs", "a WCS with its pixel_shape", "one without")
        name = str(getattr(filter, "name", filter))
        self._wcs = wcs
        self._filter = find_filter(name) or name
        #: The exposure that the image is for, or None; `~miricigale.detector.Detector.expose` asks for it.
        self.exposure = exposure
        if isinstance(catalog, str) and catalog in resources():
            catalog = read_catalog(catalog)
        sources = as_sources(catalog, self._filter, units=units, takes_units=True)
        catalog = check_catalog(sources, filters=[self._filter], wcs=wcs)
        self._catalog = BandTable(catalog, copy=False)
        if psf is None and (exposure is None or wcs is not exposure.wcs):
            # the model is in the axes of the detector
            raise argument_error("psf", "given for a grid that is not that of an exposure", "None")
        if psf is None:
            psf = miri_psf(self._filter)
        else:
            psf = as_psf(psf)
        self._shape = tuple(map(int, wcs.pixel_shape[::-1]))
        self._background = self._check_background(background)
        scale = float(np.abs(np.linalg.det(self._center_jacobian())) ** -0.5)
        self._check_psf(psf, scale)
        radius = positive(max_radius, ANGLE, "max_radius") / scale
        self._painter = Painter(
            self._shape, psf, enclosed=enclosed, max_radius=radius, n_threads=n_threads
        )
        self._cutouts = self._check_cutouts(cutouts)
        self._galaxy_flux, self._agn_flux = self._split_flux(agn)
        self._warn_of_fluxes()

    def _value(self, name):
        # half-made copies have no catalog yet
        catalog = vars(self).get("_catalog")
        if catalog is None:
            return None
        if name == "flux":
            name = self._filter
        return catalog[name] if name in catalog.colnames else None

    def _value_names(self):
        return ("flux", *self._catalog.colnames)

    def replace(self, **changes):
        """Return a scene with other values of the constructor's arguments, such as ``background="high"``."""
        return type(self)(**(self._arguments | changes))

    def __len__(self):
        return len(self._catalog)

    def __repr__(self):
        ny, nx = self._shape
        return f"<Scene {self._filter}: {len(self._catalog)} sources on {nx} x {ny} pixels>"

    catalog = property(attrgetter("_catalog"), doc="The checked catalog.")
    filter = property(attrgetter("_filter"), doc="Name of the flux column.")
    wcs = property(attrgetter("_wcs"), doc="World coordinates of the image.")
    psf = property(attrgetter("_painter.psf"), doc="The PSF.")
    background = property(attrgetter("_background"), doc="The background, or None.")

    def _check_cutouts(self, cutouts):
        """Return the cutouts by row of the catalog; refuse others, and sources without theirs."""
        cutouts = dict(cutouts or {})
        for key, value in cutouts.items():
            check_type(value, "cutouts", Cutout, f"a Cutout for {key!r}")
        rows = np.flatnonzero(self._catalog["profile"] == "cutout")
        ids = {self._catalog["id"][row].item(): int(row) for row in rows}
        if lacking := sorted(set(ids) - set(cutouts), key=str):
            raise argument_error("cutouts", "one for each profile 'cutout'", f"none for {lacking}")
        if foreign := sorted(set(cutouts) - set(ids), key=str):
            raise argument_error(
                "cutouts", "for ids whose profile is 'cutout'", f"some for {foreign}"
            )
        return {ids[key]: value for key, value in cutouts.items()}

    def _split_flux(self, agn):
        """Return the light of the profiles and of the points at their centers, uJy."""
        flux = self._catalog[self._filter].to_value(FNU)
        if agn is None:
            return flux, np.zeros(len(flux))
        wanted = f"a column of {self._catalog.colnames}"
        check_that(agn in self._catalog.colnames, "agn", wanted, repr(agn))
        column = self._catalog[agn]
        unit = own_unit(column)
        is_share = unit is None or unit == u.one
        values = plain_floats(column, agn, "catalog")
        high = 1.0
        wanted = "shares between 0 and 1"
        if not is_share:
            values = to_array(values * unit, FNU, "agn")
            high = np.finfo(float).max
            wanted = "fluxes that are finite and not negative"
        bad = (values < 0) | (values > high)
        if np.any(bad):
            row = int(np.argmax(bad))
            raise argument_error("agn", wanted, f"{column[row]} in row {row}")
        values = np.nan_to_num(values, nan=0.0)
        if is_share:
            return flux * (1 - values), flux * values
        return flux, values

    def _warn_of_fluxes(self):
        """Warn of sources that are not painted: without a finite, positive flux."""
        flux = self._galaxy_flux + self._agn_flux
        finite = np.isfinite(flux)
        kinds = {"NaN": np.isnan(flux), "infinite": np.isinf(flux), "negative": finite & (flux < 0)}
        counts = [f"{np.count_nonzero(bad)} {name}" for name, bad in kinds.items() if bad.any()]
        if not counts:
            return
        bad = ~(flux >= 0) | ~finite
        ids = self._catalog["id"][bad]
        first = ", ".join(map(str, ids[:5].tolist())) + (", ..." if len(ids) > 5 else "")
        warn(
            f"{len(ids)} of {len(self._catalog)} sources are not painted: fluxes in {self._filter!r} "
            f"are {', '.join(counts)} (flag no_flux of the truth): ids {first}",
            CatalogWarning,
        )

    def _check_background(self, background):
        """Return the `Background` of one, of its level or of how bright the zodiacal light is; None for none."""
        if background is None or isinstance(background, Background):
            return background
        if isinstance(background, str):
            background = sky_background(self._filter, background)
        wanted = "a Background, a Quantity in MJy/sr or a level such as 'low'"
        check_that(isinstance(background, u.Quantity), "background", wanted, repr(background))
        return Background(background)

    def _center_jacobian(self):
        return local_jacobian(self._wcs, *middle_pixel(self._shape))

    def _check_psf(self, psf, scale):
        """Refuse a PSF on pixels other than ``scale`` (arcsec), turned, of other places or another filter."""
        if not isinstance(psf, _TYPED):
            # a plain photutils model is taken as it is
            return
        have = psf.pixel_scale.to_value(ANGLE)
        got = f"pixels of {have:.4f} arcsec where the WCS has {scale:.4f}"
        check_that(abs(have / scale - 1) <= 0.03, "psf", "on the pixels of the WCS", got)
        if psf.frame == "sky":
            # the direction on the sky in which +y points
            east, north = np.linalg.inv(self._center_jacobian()) @ [0.0, 1.0]
            angle = np.degrees(np.arctan2(east, north))
            turn = (psf.angle.to_value(u.deg) - angle + 180) % 360 - 180
            got = f"turned by {turn:.1f} deg (see miricigale.psf.rotate_psf)"
            check_that(abs(turn) <= 1, "psf", "in the orientation of the WCS", got)
        if isinstance(psf, PSFGrid) and psf.subarray is not None:
            shape = aperture(psf.subarray).shape
            got = f"those of {psf.subarray}, {shape[1]} x {shape[0]} pixels"
            check_that(shape == self._shape, "psf", "a grid of places on this image", got)
        if psf.filter is not None:
            # other packages write F770W where we write miri.f770w
            wanted = self._filter.lower()
            have = psf.filter.lower()
            if have not in (wanted, wanted.rpartition(".")[2]):
                raise argument_error(
                    "psf", f"one of the filter {self._filter}", f"one of {psf.filter}"
                )

    @functools.cached_property
    def _painted(self):
        """The light in each pixel (uJy), and the table of truth."""
        catalog = self._catalog
        flux = self._galaxy_flux + self._agn_flux
        x, y, is_near = pixel_positions(self._wcs, catalog["sky"], self._shape)
        inside = is_near & is_inside(x, y, self._shape)
        valid = np.isfinite(flux) & (flux >= 0)
        sersic = catalog["profile"] == "sersic"
        spoilt = (catalog["flags"] & int(CatalogFlags.unusable_profile())) != 0
        flags = np.zeros(len(catalog), dtype=int)
        flags[~inside] |= SceneFlags.OUTSIDE_IMAGE
        flags[~valid] |= SceneFlags.NO_FLUX
        flags[sersic & spoilt] |= SceneFlags.DRAWN_AS_POINT
        sersic &= ~spoilt
        image, in_image, lost = self._paint(np.flatnonzero(is_near & valid), x, y, sersic)
        flags[lost > 0.01] |= SceneFlags.CUT_PROFILE
        dim = in_image < 0.95 * flux * (1 - lost) * self._painter.enclosed_by_psf
        flags[inside & valid & dim] |= SceneFlags.NEAR_EDGE
        painted_as = np.where(sersic, "sersic", "point").astype("U6")
        painted_as[list(self._cutouts)] = "cutout"
        columns = {
            "id": catalog["id"],
            "sky": catalog["sky"],
            "x": x,
            "y": y,
            "profile": painted_as,
            "flux_total": flux * FNU,
            "flux_agn": self._agn_flux * FNU,
            "flux_in_image": in_image * FNU,
            "flags": flags,
        }
        texts = column_texts("miricigale.scene", "truth") | {"flags": SceneFlags.describe()}
        return image, described_columns(columns, texts, provenance(filter=self._filter))

    def _paint(self, rows, x, y, sersic):
        """
        Paint sources of the catalog at pixels x and y, as profiles (``sersic``, cutouts) or points.

        Returned are the light in each pixel (uJy), and of each source the light in the image (uJy) and the part of
        its light that lies beyond the isophote where it is cut.
        """
        catalog = self._catalog
        galaxy = self._galaxy_flux
        agn = self._agn_flux
        n_profiles = rows.size
        profile_rows = rows
        # after the profiles the points at their centers
        rows = np.append(rows, rows[agn[rows] > 0])
        profile = np.arange(rows.size) < n_profiles
        jacobian = local_jacobian(self._wcs, x[rows], y[rows])
        is_sersic = sersic[rows] & profile
        radius, ratio, theta = ellipse_to_pixels(
            jacobian,
            radius=np.where(is_sersic, catalog["half_light_radius"].to_value(ANGLE)[rows], 0),
            axis_ratio=np.where(is_sersic, catalog["axis_ratio"][rows], 1.0),
            position_angle=np.nan_to_num(catalog["position_angle"].to_value(u.rad))[rows],
        )
        images = {}
        for k, row in enumerate(profile_rows):
            if row in self._cutouts:
                images[k] = self._cutouts[row].pieces(jacobian[k])
        image, landed, drawn_share = self._painter.paint(
            x=x[rows],
            y=y[rows],
            flux=np.where(profile, galaxy[rows], agn[rows]),
            is_sersic=is_sersic,
            r_eff=radius,
            n=catalog["sersic_index"][rows],
            axis_ratio=ratio,
            theta=theta,
            images=images,
        )
        in_image = np.bincount(rows, weights=landed, minlength=len(catalog))
        # of all light, the points' included
        lost = np.zeros(len(catalog))
        flux = galaxy[profile_rows] + agn[profile_rows]
        total = np.where(flux > 0, flux, 1.0)
        lost[profile_rows] = (1 - drawn_share[:n_profiles]) * galaxy[profile_rows] / total
        return image, in_image, lost

    @property
    def truth(self):
        """
        What is in the image, one row for each row of the catalog.

        A `~astropy.table.QTable` with ``id``, ``sky``, ``x``, ``y`` (pixels), ``profile`` as
        painted, ``flux_total``, ``flux_agn`` (of it), ``flux_in_image`` and ``flags``
        (`SceneFlags`).
        """
        return BandTable(self._painted[1], copy=True)

    def to_table(self):
        """Return what is in the image: `truth`."""
        return self.truth

    def write(self, path, *, overwrite=False):
        """
        Write the image that `render` makes.

        Parameters
        ----------
        path : path-like
            A FITS file.
        overwrite : bool, optional
            Whether a file of that name is replaced.
        """
        self.render().write(path, overwrite=overwrite)

    @takes_other_keywords
    def render(self):
        """
        Make the image.

        Returns
        -------
        image : `~astropy.nddata.CCDData`
            Surface brightness in MJy/sr on the WCS; ``meta["psf_includes"]`` says what of
            the detector is in the PSF already, ``meta["background"]`` the level at the
            center.
        """
        light = self._painted[0]
        brightness = light * _UJY_TO_MJY / pixel_area_map(self._wcs, self._shape)
        includes = []
        if isinstance(self.psf, _TYPED):
            includes = list(self.psf.includes)
        n = len(self._catalog)
        meta = provenance(filter=self._filter, psf_includes=includes, n_sources=n)
        if self._background is not None:
            brightness += self._background.image(self._wcs, self._shape)
            meta["background"] = float(self._background.level.value)
        return Image(brightness, unit=SURFACE_BRIGHTNESS, wcs=self._wcs, meta=meta)

    def plot(self, ax=None, *, background=False, sources=False, **kwargs):
        """
        Draw the image, scaled by asinh.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where; the current axes by default.
        background : bool, optional
            Whether the background is in the picture (its gradient hides faint sources).
        sources : bool, optional
            Whether positions are marked.
        **kwargs
            Passed to `~matplotlib.axes.Axes.imshow`.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`
        """
        from miricigale.plotting.axes import plain_text
        from miricigale.plotting.scene import plot_scene

        truth = self._painted[1]
        marks = None
        if sources:
            shown = (truth["flags"] & SceneFlags.OUTSIDE_IMAGE) == 0
            marks = truth["x"][shown], truth["y"][shown]
        label = f"{plain_text(self._filter)} (MJy / sr)"
        image = self.render().data
        if self._background is not None and not background:
            image = image - self._background.image(self._wcs, self._shape)
        return plot_scene(image, ax=ax, marks=marks, label=label, **kwargs)
