"""HTML pages from text, tables and figures; they know nothing of astronomy."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "page": ("Page",),
        "rendering": ("render",),
        "values": ("Link", "Missing", "cell_of", "number"),
    },
)
