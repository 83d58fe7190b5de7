"""Settings of the package, in the file ``miricigale.cfg`` of astropy's configuration folder."""

import functools

from astropy.config import ConfigItem, ConfigNamespace

# settings at the top of the file, whatever this module is called
_item = functools.partial(ConfigItem, module="miricigale")


class Conf(ConfigNamespace):
    """Settings of the package, kept in astropy's configuration folder."""

    data_folder = _item(
        "", "Folder for reference data that the user brings; empty: astropy's cache folder."
    )
    cache_folder = _item("", "Folder for what can be made again; empty: astropy's cache folder.")
    grid_cache_size = _item(
        1000, "Size in MB to which the cache of model grids may grow; 0: none.", "integer(min=0)"
    )
    unpacked_size = _item(
        4000,
        "Size in MB to which a packed file may unpack, or eight times its size if that is more.",
        "integer(min=1)",
    )


conf = Conf()
