"""What an image says of itself, as far as work depends on it."""

import dataclasses
import numbers

from miricigale.utils.exceptions import argument_error
from miricigale.utils.named_values import field_names


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImageFacts:
    """
    What an image says of itself, as far as work depends on it.

    What was done to it is its `ExposureHistory`; everything else in its meta dictionary is for people.

    Parameters
    ----------
    filter : str, optional
        Name of the filter.
    subarray : str, optional
        Name of the sub-array.
    psf_includes : tuple of str, optional
        What of the detector the PSF of the image holds, such as ``("pixel", "ipc")``. A text is
        taken apart at commas and blanks, as a header keeps it.
    ipc : bool, optional
        Whether neighboring pixels share charge.
    noise_correction : float, optional
        By how much sums over many pixels are noisier than their errors in quadrature.
    n_outliers : int, optional
        Pixels that disagreed with the other dithers; None if outliers were not searched for.

    Raises
    ------
    ValueError
        If a value is of another kind; the message names the key of the meta dictionary.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import ImageFacts
    >>> meta = {"filter": "miri.f770w", "psf_includes": "pixel, ipc"}
    >>> facts = ImageFacts.of(CCDData(np.ones((4, 4)), unit="MJy/sr", meta=meta))
    >>> facts.filter, facts.psf_includes
    ('miri.f770w', ('pixel', 'ipc'))
    """

    filter: str | None = None
    subarray: str | None = None
    psf_includes: tuple = ()
    ipc: bool = False
    noise_correction: float = 1.0
    n_outliers: int | None = None

    def __post_init__(self):
        names = self.psf_includes
        if isinstance(names, str):
            names = names.replace(",", " ").split()
        object.__setattr__(self, "psf_includes", tuple(str(name).lower() for name in names))
        for name, kind, wanted in (
            ("filter", str, "a name"),
            ("subarray", str, "a name"),
            ("ipc", (bool, numbers.Integral), "True or False"),
            ("noise_correction", numbers.Real, "a number"),
            ("n_outliers", numbers.Integral, "an integer"),
        ):
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise argument_error("image", f"one whose meta[{name!r}] is {wanted}", repr(value))

    @classmethod
    def of(cls, image):
        """
        Return the facts of an image.

        Parameters
        ----------
        image : `~astropy.nddata.CCDData` or other
            Its meta dictionary is read; what has none says nothing.

        Returns
        -------
        facts : `ImageFacts`
        """
        meta = getattr(image, "meta", None) or {}
        names = field_names(cls)
        return cls(**{name: meta[name] for name in names if meta.get(name) is not None})

    @property
    def band(self):
        """The filter without its instrument, lower case: headers write F770W for miri.f770w."""
        if self.filter is None:
            return None
        return self.filter.lower().rpartition(".")[2]
