"""The library of filter curves: names, and where astro-sedpy, or our own table, keeps each."""

import importlib.metadata
from importlib.util import find_spec
from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale.refdata import Registry, citations, locate
from miricigale.utils.exceptions import DataError
from miricigale.utils.options import check_data, check_names
from miricigale.utils.package_tables import declared
from miricigale.utils.units import WAVE

_RESOURCE = "filters.sedpy"

#: Prefix of the names that stand for any curve of astro-sedpy.
SEDPY = "sedpy."


def curve_folder():
    """Return the folder of astro-sedpy with the curves; the package itself is not imported."""
    spec = find_spec("sedpy")
    if spec is None or spec.origin is None:
        raise DataError("astro-sedpy with its curves is not installed: pip install astro-sedpy")
    return Path(spec.origin).parent / "data" / "filters"


def _resource(curve):
    if "." in curve:
        return f"filters.{curve.partition('.')[0]}"
    return _RESOURCE


def read_curve(curve):
    """
    Read a curve of astro-sedpy, or one of ours (whose names have a dot): wavelengths in um, ascending, photon
    response, and how many values were negative (noise of the measurement) and are set to 0.
    """
    bundled = "." in curve
    if bundled:
        path = locate(_resource(curve))
    else:
        path = curve_folder() / f"{curve}.par"
    # the files are yanny tables; in some the rows lack the leading table name
    rows = []
    for line in path.read_text(encoding="latin-1").splitlines():
        words = line.split("#")[0].split()
        if bundled and words[:1] != [curve]:
            continue
        try:
            rows.append((float(words[-2]), float(words[-1])))
        except (IndexError, ValueError):
            continue
    check_data(len(rows) >= 2, path, "holds no filter curve")
    wave, throughput = np.array(rows).T
    wave, index = np.unique(wave, return_index=True)
    throughput = throughput[index]
    good = np.isfinite(throughput) & (wave > 0)
    wave = wave[good]
    throughput = throughput[good]
    n_negative = int(np.count_nonzero(throughput < 0))
    return wave * 1e-4, np.maximum(throughput, 0), n_negative


def _load(name):
    metadata = {}
    if not name.startswith(SEDPY):
        metadata = FILTERS.metadata(name)
    curve = metadata.pop("curve", name.removeprefix(SEDPY))
    wave, throughput, n_negative = read_curve(curve)
    resource = _resource(curve)
    version = importlib.metadata.version("astro-sedpy")
    meta = {
        "source": f"{f'astro-sedpy {version}' if resource == _RESOURCE else resource}, {curve}",
        "citations": citations(resource),
        "flux_convention": metadata.pop("flux_convention", "AB"),
    }
    if n_negative:
        meta["n_negative"] = n_negative
    return wave * WAVE, throughput, {"meta": meta, **metadata}


def load_curve(name):
    """Return the wavelengths, throughput and options of `Filter` of a filter of the library."""
    if name.startswith(SEDPY):
        curves = [path.stem for path in curve_folder().glob("*.par")]
        check_names([name.removeprefix(SEDPY)], "curve of astro-sedpy", curves)
        return _load(name)
    return FILTERS.get(name)


def _register():
    """Return the registry of ``library.toml``."""
    registry = Registry("filter")
    for instrument, group in declared("miricigale.filters", "library.toml").items():
        bands = group["bands"]
        metadata = {}
        if "flux_convention" in group:
            metadata["flux_convention"] = group["flux_convention"]
        for band in bands:
            if "curves" in group:
                curve = group["curves"].format(band)
            else:
                curve = bands[band]
            if "reference_wavelength" in group:
                metadata["reference_wavelength"] = group["reference_wavelength"][band] * WAVE
            if "reference_temperature" in group:
                metadata["reference_temperature"] = group["reference_temperature"] * u.K
            registry.register(f"{instrument}.{band}", _load, curve=curve, **metadata)
    return registry


#: The registry of the library; its public access is `Filter.from_name`.
FILTERS = _register()
