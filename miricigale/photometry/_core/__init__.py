"""
Arrays-only kernels of forced photometry: sampling of templates, normal equations, covariances.

Stamps of all shapes lie one after the other in a flat array; ``start[k]`` is where stamp ``k``
begins and ``box[k] = (y0, x0, ny, nx)`` where it lies on the target image. Sums run in float64
in a fixed order, so that answers do not depend on the number of threads; no kernel holds the
interpreter's lock, and each is called with one set of types, so that it is compiled once.
"""
