"""
Arrays-only kernels of forced photometry: sampling of templates, normal equations, covariances.

Stamps of all shapes lie one after the other in a flat array; ``start[k]`` is where stamp ``k``
begins and ``box[k] = (y0, x0, ny, nx)`` where it lies on the target image. Sums run in float64
in a fixed order, so that answers do not depend on the number of threads; no kernel holds the
interpreter's lock, and each is called with one set of types, so that it is compiled once.
"""

from miricigale.photometry._core.noise import autocorrelation
from miricigale.photometry._core.sampling import (
    box_response,
    convolve_batch,
    sample_stamps,
    spline_response,
)
from miricigale.photometry._core.shapes import INDEX_RANGE, shape_models
from miricigale.photometry._core.solve import block_covariance, factorize
from miricigale.photometry._core.stamps import (
    add_model,
    convolve_stamps,
    cross_pairs,
    find_pairs,
    pair_products,
    projections,
    residual_statistics,
    whiten_stamps,
)
