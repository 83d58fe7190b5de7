"""Photometry of points on files: positions of a catalog, without a high-resolution image."""

import dataclasses
import os

from miricigale.instrument import epoch_of
from miricigale.photometry.commands.file_inputs import (
    Inputs,
    Pixels,
    check_filter,
    check_on_image,
)
from miricigale.photometry.commands.kernel_files import can_be_modeled, image_psf
from miricigale.photometry.detection.prior_catalog import read_catalog
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import file_place


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointInputs(Inputs):
    """
    Images on which the sources of a catalog are measured as points.

    ``highres`` is the first image, which stands on pages where a prior would.
    """

    @classmethod
    def of(cls, image, highres=None, **settings):
        """Make inputs of the arguments of `~miricigale.photometry.measure_files`, without a prior."""
        for argument in ("segmentation", "detection", "kernel"):
            if settings.get(argument):
                wanted = "left out without a high-resolution image"
                raise argument_error(argument, wanted, settings[argument])
        if settings.get("catalog") is None:
            wanted = "given, or a catalog, whose sources are points"
            raise argument_error("highres", wanted, "None")
        images = image
        if not isinstance(image, (list, tuple)):
            images = [image]
        return super().of(images, images[0], **settings)

    @property
    def prior_meta(self):
        """Nothing, as there is no prior: dict."""
        return {}

    def check(self):
        """Refuse, before any image is read, what is missing, or not what it should be."""
        catalog = file_place(self.catalog)[0]
        if not os.path.isfile(catalog):
            msg = f"no file {self.catalog} ('catalog')"
            raise DataError(msg)
        for file in self.images:
            check_filter(file)
            if file.psf is None and not can_be_modeled(file.header):
                wanted = f"given, for there is no model PSF for {file.path} (or give 'pa_aper')"
                raise argument_error("psf", wanted, None)
            sky = read_catalog(self.catalog, epoch=epoch_of(file.header))["sky"]
            check_on_image(sky, self.catalog, file, "image")
        self._check_bands()

    def read(self, prior=None, images=None):
        """Read the images; the first one stands in for the prior."""
        pixels = {}
        for band, file in zip(self.bands, self.images, strict=True):
            pixels[band] = file.read()
        return Pixels(pixels[self.bands[0]], [], pixels)

    def photometers(self, n_threads=None):
        """Make the `~miricigale.photometry.ForcedPhotometer` of each band: dict by name of the filter."""
        from miricigale.photometry import ForcedPhotometer

        options = self.fit_options(n_threads)
        photometers = {}
        for band, file in zip(self.bands, self.images, strict=True):
            psf = image_psf(file)
            photometers[band] = ForcedPhotometer(psf=psf, psf_stars=self.psf_stars, **options)
        return photometers

    def find_sources(self, pixels, catalog, part=None):
        """Read the sources of the catalog; there are no segments."""
        return None, read_catalog(catalog, epoch=epoch_of(self.images[0].header))

    def _results(self, pixels, photometers, segments, sources):
        results = {}
        for band, photometer in photometers.items():
            results[band] = photometer.measure(pixels.images[band], catalog=sources)
        return results
