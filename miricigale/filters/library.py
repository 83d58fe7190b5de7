"""The library of filter curves: names, and where astro-sedpy, or our own table, keeps each."""

import importlib.metadata
from importlib.util import find_spec
from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale.refdata import Registry, citations, locate
from miricigale.utils.exceptions import DataError, data_error
from miricigale.utils.options import check_names
from miricigale.utils.units import WAVE

_RESOURCE = "filters.sedpy"

_MIRI = "f560w f770w f1000w f1130w f1280w f1500w f1800w f2100w f2550w"
_NIRCAM = (
    "f070w f090w f115w f140m f150w f150w2 f162m f182m f200w f210m f250m f277w f300m f322w2 "
    "f335m f356w f360m f410m f430m f444w f460m f480m"
)
_ACS = "f435w f475w f555w f606w f625w f775w f814w f850lp"
_WFC3 = "f098m f105w f110w f125w f140w f160w"

# nominal wavelengths (um) at which the catalogs of Spitzer quote fluxes
_IRAC = {"ch1": 3.550, "ch2": 4.493, "ch3": 5.731, "ch4": 7.872}
_MIPS = {"24": 23.68, "70": 71.42, "160": 155.9}

#: Prefix of the names that stand for any curve of astro-sedpy.
SEDPY = "sedpy."


def curve_folder():
    """The folder of astro-sedpy with the curves; the package itself is not imported."""
    spec = find_spec("sedpy")
    if spec is None or spec.origin is None:
        msg = (
            "astro-sedpy, which holds the filter curves, is not installed: pip install astro-sedpy"
        )
        raise DataError(msg)
    return Path(spec.origin).parent / "data" / "filters"


def _resource(curve):
    return f"filters.{curve.partition('.')[0]}" if "." in curve else _RESOURCE


def read_curve(curve):
    """
    Read a curve of astro-sedpy, or one of ours (whose names have a dot): wavelengths in um, ascending, photon
    response, and how many values were negative (noise of the measurement) and are set to 0.
    """
    bundled = "." in curve
    path = locate(_resource(curve)) if bundled else curve_folder() / f"{curve}.par"
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
    if len(rows) < 2:
        raise data_error(path, "holds no filter curve")
    wave, throughput = np.array(rows).T
    wave, index = np.unique(wave, return_index=True)
    throughput = throughput[index]
    good = np.isfinite(throughput) & (wave > 0)
    wave, throughput = wave[good], throughput[good]
    n_negative = int(np.count_nonzero(throughput < 0))
    return wave * 1e-4, np.maximum(throughput, 0), n_negative


def _load(name):
    metadata = {} if name.startswith(SEDPY) else FILTERS.metadata(name)
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
    """Wavelengths, throughput and options of `Filter` of a filter of the library."""
    if name.startswith(SEDPY):
        known = [path.stem for path in curve_folder().glob("*.par")]
        check_names([name.removeprefix(SEDPY)], "curve of astro-sedpy", known)
        return _load(name)
    return FILTERS.get(name)


def _register():
    registry = Registry("filter")

    def add(name, curve, **metadata):
        registry.register(name, _load, curve=curve, **metadata)

    for instrument, prefix, bands in (
        ("miri", "jwst_", _MIRI),
        ("nircam", "jwst_", _NIRCAM),
        ("acs", "acs_wfc_", _ACS),
        ("wfc3", "wfc3_ir_", _WFC3),
    ):
        for band in bands.split():
            add(f"{instrument}.{band}", f"{prefix}{band}")
    for band, number in (("u", 9301), ("g", 9401), ("r", 9601), ("i", 9701), ("z", 9801)):
        add(f"megacam.{band}", f"cfht_megacam_{band}s_{number}")
        add(f"megacam2015.{band}", f"megacam2015.{band}")
    for band in "zyjhk":
        add(f"wfcam.{band}", f"wfcam.{band}" if band in "zy" else f"ukirt_wfcam_{band.upper()}")
    for band in ("j1", "j2", "j3", "h1", "h2", "k"):
        add(f"newfirm.{band}", f"mayall_newfirm_{band.upper()}")
    for band, wave in _IRAC.items():
        add(
            f"irac.{band}",
            f"spitzer_irac_{band}",
            flux_convention="nu F_nu = const",
            reference_wavelength=wave * WAVE,
        )
    for band, wave in _MIPS.items():
        add(
            f"mips.{band}",
            f"spitzer_mips_{band}",
            flux_convention="black body",
            reference_wavelength=wave * WAVE,
            reference_temperature=1e4 * u.K,
        )
    return registry


#: The registry of the library; its public access is `Filter.from_name`.
FILTERS = _register()
