"""Parts of a spectrum: stars, dust and AGN, and their sums."""

import functools
import operator

from miricigale.utils.exceptions import unknown_name


class Parts(dict):
    """
    Parts of a spectrum by name.

    ``"agn"`` is the sum of those of the AGN, ``"galaxy"`` that of the others, so that both make up the whole.
    """

    def __missing__(self, name):
        groups = {"agn": [], "galaxy": []}
        for key, part in self.items():
            # light before attenuation is no part of the whole
            if not key.endswith("_intrinsic"):
                groups["agn" if key.startswith("agn_") else "galaxy"].append(part)
        groups = {group: parts for group, parts in groups.items() if parts}
        if name not in groups:
            raise unknown_name("component", name, [*self, *groups])
        return functools.reduce(operator.add, groups[name])
