"""Kernels of exposures that are fitted together: one, or a field of them, for each exposure."""

import dataclasses
import functools

from miricigale.psf import KernelField, MatchingKernel
from miricigale.utils.exceptions import argument_error


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ExposureKernels:
    """
    Kernels from one high-resolution image to several exposures, in their order.

    Parameters
    ----------
    kernels : sequence of `~miricigale.psf.MatchingKernel` or `~miricigale.psf.KernelField`
        On the same pixels, with their PSFs.

    Raises
    ------
    ValueError
        If there is none, one is something else or has no PSFs, or they differ in form.
    """

    kernels: tuple

    def __post_init__(self):
        kernels = tuple(self.kernels)
        object.__setattr__(self, "kernels", kernels)
        wanted = "a MatchingKernel or a KernelField for each exposure"
        if not kernels:
            raise argument_error("kernel", wanted, "none")
        for one in kernels:
            if not isinstance(one, (MatchingKernel, KernelField)):
                raise argument_error("kernel", wanted, type(one).__name__)
            mean = one.mean if isinstance(one, KernelField) else one
            if mean.source is None or mean.target is None:
                raise argument_error("kernel", "kernels with their PSFs", "one without")

    def __len__(self):
        return len(self.kernels)

    def __repr__(self):
        return f"<ExposureKernels for {len(self)} exposures, {self.mean!r}>"

    @functools.cached_property
    def mean(self):
        """The mean `~miricigale.psf.MatchingKernel`."""
        means = [one.mean if isinstance(one, KernelField) else one for one in self.kernels]
        return MatchingKernel.blend(means)
