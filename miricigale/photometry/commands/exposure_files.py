"""Forced photometry of files of exposures: several of one filter are fitted together."""

import collections
import dataclasses
from pathlib import Path

from miricigale.photometry.commands.file_inputs import (
    Inputs,
    Measurement,
    Pixels,
    short_band,
)
from miricigale.photometry.commands.kernel_files import image_psf, matching_kernel
from miricigale.utils.exceptions import argument_error
from miricigale.utils.named_values import field_values, subset
from miricigale.utils.options import check_that


def with_exposures(inputs):
    """
    Return the inputs as they are, or as `ExposureInputs` if several are exposures of one filter.

    Parameters
    ----------
    inputs : `~miricigale.photometry.commands.file_inputs.Inputs`
        The files.

    Returns
    -------
    inputs : `~miricigale.photometry.commands.file_inputs.Inputs`
    """
    if len(inputs.images) == 1:
        return inputs
    counts = collections.Counter(inputs.bands)
    repeated_files = [file for file in inputs.images if counts[file.header.filter] > 1]
    if not repeated_files or not all(file.header.exposure for file in repeated_files):
        return inputs
    return ExposureInputs(**field_values(inputs))


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExposureInputs(Inputs):
    """Files of a measurement, some of which are exposures of one filter, that are fitted together."""

    @property
    def groups(self):
        """Numbers of the images of each filter: dict of str to list of int."""
        groups = {}
        for k, band in enumerate(self.bands):
            groups.setdefault(band, []).append(k)
        return groups

    @property
    def labels(self):
        """As of `Inputs`, with the names of the exposures, without that of their kind of product."""
        labels = []
        for band, rows in self.groups.items():
            for k in rows:
                name = Path(str(self.images[k].path)).name.partition(".")[0]
                # models and residuals are no products of JWST
                name = name.removesuffix("_cal").removesuffix("_crf")
                parts = []
                if len(self.groups) > 1:
                    parts.append(short_band(band))
                if len(rows) > 1:
                    parts.append(name)
                labels.append("_".join(parts))
        return labels

    def check(self):
        """Check as `Inputs` does; options that exposures do not have are refused too."""
        super().check()
        for name, offered in (("components", 1), ("offset_order", None)):
            value = self.options.get(name, offered)
            check_that(value == offered, name, f"{offered} for exposures of one filter", value)
        if self.options.get("background_order", 0) is None:
            wanted = "0 to 4 for exposures of one filter, each of which has a sky of its own"
            raise argument_error("background_order", wanted, None)
        check_that(not self.psf_stars, "psf_stars", "left out for exposures of one filter", True)

    def _check_bands(self):
        """Accept several images of a filter, which are exposures: see `with_exposures`."""

    def read(self, prior=None, images=None):
        """Read the images, those of one filter as a list."""
        if prior is not None or images is not None:
            raise argument_error(
                "prior, images", "None for exposures, which are read whole", "parts"
            )
        images_of_band = {}
        for band, rows in self.groups.items():
            images_of_band[band] = [self.images[k].read() for k in rows]
            if len(rows) == 1:
                images_of_band[band] = images_of_band[band][0]
        return Pixels(self.highres.read(), [file.read() for file in self.detection], images_of_band)

    def photometers(self, n_threads=None):
        """Make photometers as `Inputs` does; the kernels of exposures are those of their places and rolls."""
        single = [rows[0] for rows in self.groups.values() if len(rows) == 1]
        photometers = {}
        if single:
            mosaics = dataclasses.replace(
                self,
                images=tuple(self.images[k] for k in single),
                kernels=tuple(self.kernels[k] for k in single),
            )
            photometers = Inputs.photometers(mosaics, n_threads)
        from miricigale.photometry.fit.forced import ForcedPhotometer

        options = self.fit_options(n_threads)
        for band, rows in self.groups.items():
            if len(rows) > 1:
                photometers[band] = ForcedPhotometer(
                    self._kernels(rows), psf_stars=False, **options
                )
        return subset(photometers, self.groups)

    def _kernels(self, rows):
        """Make the kernels of some exposures: of files, or models by place and roll."""
        # PSFs are heavy, and files are checked before
        from miricigale.photometry.fit.exposure_kernels import ExposureKernels

        files = [self.images[k] for k in rows]
        modeled = files[0].header.filter.startswith("miri.")
        for k in rows:
            modeled = modeled and self.kernels[k] is None and self.images[k].psf is None
        if modeled:
            sharp = image_psf(self.highres, "highres_psf")
            headers = [file.header for file in files]
            return ExposureKernels.from_images(headers, self.highres.header, sharp)
        kernels = []
        for k, file in zip(rows, files, strict=True):
            kernels.append(matching_kernel(file, self.highres, self.kernels[k]))
        return ExposureKernels(kernels)

    def measure(self, pixels, photometers, segments, sources):
        """Measure the sources: an `ExposureMeasurement`."""
        from miricigale.photometry.fit.bands import measure_prior

        results = measure_prior(pixels.images, photometers, pixels.prior, segments, sources)
        return ExposureMeasurement(self, pixels, photometers, segments, results)


class ExposureMeasurement(Measurement):
    """What was measured, some of it on exposures."""

    def products(self, name):
        """Return models or residuals, one for each image in the order of the labels."""
        products = []
        for result in self.results.values():
            if result.exposures is None:
                products.append(getattr(result, f"{name}_image"))
            else:
                products += getattr(result.exposures, f"{name}_images")
        return products

    def _shown(self, band):
        """Return the first exposure with a name for all, and pulls of points fitted to all residuals."""
        from miricigale.photometry.commands.page import empty_positions, pulls_at

        images = self.pixels.images[band]
        result = self.results[band]
        if result.exposures is None:
            return images, None
        image = images[0].copy()
        name = Path(image.meta["source"]).name
        image.meta["source"] = f"{name} and {len(images) - 1} more"
        empty = empty_positions(result, self.inputs.seed)
        if not len(empty):
            return image, None
        residuals = list(result.exposures.residual_images)
        return image, pulls_at(empty, self.photometers[band].kernel, residuals)
