"""Names of bands: of CIGALE, old and new, and of surveys, for ours."""

import os
import re
from functools import cache
from pathlib import Path

from miricigale.filters.filter import Filter
from miricigale.filters.library import SEDPY, curve_folder
from miricigale.utils.exceptions import argument_error

__all__ = [
    "band_filters",
    "cigale_band",
    "filter_of_band",
    "given_filters",
    "is_line",
    "xray_energies",
]

#: Names without a rule: CIGALE's to ours.
_NAMES = {
    "FUV": "sedpy.galex_FUV",
    "NUV": "sedpy.galex_NUV",
    "PSW": "sedpy.herschel_spire_250",
    "PMW": "sedpy.herschel_spire_350",
    "PLW": "sedpy.herschel_spire_500",
    "PACS_blue": "sedpy.herschel_pacs_70",
    "PACS_green": "sedpy.herschel_pacs_100",
    "PACS_red": "sedpy.herschel_pacs_160",
    "herschel.spire.PSW": "sedpy.herschel_spire_250",
    "herschel.spire.PMW": "sedpy.herschel_spire_350",
    "herschel.spire.PLW": "sedpy.herschel_spire_500",
    # the curves of extended sources, which differ by the beam's area along the band
    "PSW_ext": "sedpy.herschel_spire_250",
    "PMW_ext": "sedpy.herschel_spire_350",
    "PLW_ext": "sedpy.herschel_spire_500",
    "herschel.spire.PSW_ext": "sedpy.herschel_spire_250",
    "herschel.spire.PMW_ext": "sedpy.herschel_spire_350",
    "herschel.spire.PLW_ext": "sedpy.herschel_spire_500",
    "MIPS1": "mips.24",
    "MIPS2": "mips.70",
    "MIPS3": "mips.160",
    "ISAAC_KS": "sedpy.vlt_isaac_Ks",
    "VIMOS_U": "sedpy.vlt_vimos_U",
    "cfht.wircam.J": "sedpy.cfht_wircam_J_8101",
    "cfht.wircam.H": "sedpy.cfht_wircam_H_8201",
    "cfht.wircam.Ks": "sedpy.cfht_wircam_Ks_8302",
    "WIRCAM_K": "sedpy.cfht_wircam_Ks_8302",
    "MOSAIC_U": "sedpy.mayall_mosaic_U_k1001",
}

_MIRI = "560W|770W|1000W|1130W|1280W|1500W|1800W|2100W|2550W"
_NIRCAM = "070W|090W|115W|150W|200W|277W|356W|444W"

# of several rules for one filter the first is the one for names in the other direction; in the
# second column {0} stands for the band as written, {1} for it in lower case
_RULES = (
    (r"jwst\.miri\.(F\d+W)", "miri.{1}", "jwst.miri.{}"),
    (r"jwst\.nircam\.(F\d+[WM]2?)", "nircam.{1}", "jwst.nircam.{}"),
    (r"jwst\.niriss\.(F\d+[WM])", "sedpy.jwst_niriss_{1}", "jwst.niriss.{}"),
    (r"hst\.wfc3\.(F(?:098M|105W|110W|125W|140W|160W))", "wfc3.{1}", "hst.wfc3.{}"),
    (r"hst\.wfc3\.(F\d+W)", "sedpy.wfc3_uvis_{1}", "hst.wfc3.{}"),
    (r"hst\.(?:acs\.)?wfc\.(F\d+(?:W|LP))", "acs.{1}", "hst.wfc.{}"),
    (r"hst\.acs\.(F\d+(?:W|LP))", "acs.{1}", "hst.wfc.{}"),
    (r"spitzer\.irac\.(ch[1-4])", "irac.{1}", "spitzer.irac.{}"),
    (r"spitzer\.mips\.(24|70|160)", "mips.{0}", "spitzer.mips.{}"),
    (r"herschel\.pacs\.(70|100|160)", "sedpy.herschel_pacs_{0}", "herschel.pacs.{}"),
    (r"galex\.(FUV|NUV)", "sedpy.galex_{0}", "galex.{}"),
    (r"cfht\.megacam\.([ugriz])", "megacam.{0}", "cfht.megacam.{}"),
    (r"(?:sdss|SDSS)\.([ugriz])p?", "sedpy.sdss_{0}0", "sdss.{}p"),
    (r"2mass\.(J|H|Ks)", "sedpy.twomass_{0}", "2mass.{}"),
    (r"WISE([1-4])", "sedpy.wise_w{0}", "WISE{}"),
    (r"ukirt\.(?:wfcam\.)?(J|H|K)", "sedpy.ukirt_wfcam_{0}", "ukirt.{}"),
    (r"vista\.vircam\.(Z|Y|J|H|Ks)", "sedpy.vista_vircam_{0}", "vista.vircam.{}"),
    (r"subaru\.hsc\.([grizy])", "sedpy.hsc_{0}", "subaru.hsc.{}"),
    (r"subaru\.suprime\.(?:IB|IA)(\d{3})", "sedpy.subaru_suprimecam_ia{0}", "subaru.suprime.IB{}"),
    (r"subaru\.suprime\.([BV])", "sedpy.subaru_suprimecam_{0}", "subaru.suprime.{}"),
    (r"subaru\.suprime\.([riz])", "sedpy.subaru_suprimecam_{0}p", "subaru.suprime.{}"),
    # the older, short names
    (rf"(F(?:{_MIRI}))", "miri.{1}", None),
    (rf"(F(?:{_NIRCAM}))", "nircam.{1}", None),
    (r"(?:WFC3|wfc3|HST-WFC3_IR\.)_?([Ff](?:098[Mm]|1\d\d[Ww]))", "wfc3.{1}", None),
    (r"(F\d+W)_UVIS_CHIP[12]", "sedpy.wfc3_uvis_{1}", None),
    (r"([ugriz])_prime", "sedpy.sdss_{0}0", None),
    (r"(J|H|Ks)_2mass", "sedpy.twomass_{0}", None),
    (r"LSST_([ugrizy])", "sedpy.lsst_baseline_{0}", None),
    (r"([UBVRI])_B90", "sedpy.bessell_{0}", None),
    # those of CANDELS and COSMOS
    (r"CFHT_([ugriz])", "megacam.{0}", None),
    (r"ISAAC_(J|H)", "sedpy.vlt_isaac_{0}", None),
    (r"SC_I[AB](\d{3})", "sedpy.subaru_suprimecam_ia{0}", None),
    (r"SC_(B|V|rp|ip|zp)", "sedpy.subaru_suprimecam_{0}", None),
)
_XRAY = re.compile(r"xray_boxcar_(\d+(?:p\d+)?)to(\d+(?:p\d+)?)keV")
_COMPILED = tuple((re.compile(rule), ours, back) for rule, ours, back in _RULES)

#: Instruments whose names are written in many ways, in any case and with any of . _ between the parts;
#: the last part is the band, {} in our name, written as the curve is.
_FREE = tuple(
    (re.compile(rule, re.IGNORECASE), ours)
    for rule, ours in (
        (r"(?:jwst[._-])?nircam[._-]?(F\d+[WMN]2?)", "nircam.{}"),
        (r"(?:jwst[._-])?miri[._-]?(F\d+W)", "miri.{}"),
        (r"(?:hst[._-])?(?:wfc3|wfc3[._-]ir)[._-](F\d+[WM])", "wfc3.{}"),
        (r"(?:hst[._-])?(?:wfc3[._-])?uvis[._-](F\d+W)", "sedpy.wfc3_uvis_{}"),
        (r"(?:hst[._-])?(?:acs|acs[._-]wfc|wfc)[._-](F\d+(?:W|LP))", "acs.{}"),
        (r"(?:spitzer[._-])?irac[._-]?(?:ch|i)?([1-4])", "irac.ch{}"),
        (r"(?:spitzer[._-])?mips[._-]?(24|70|160)", "mips.{}"),
        (r"(?:herschel[._-])?pacs[._-]?(70|100|160)", "sedpy.herschel_pacs_{}"),
        (r"(?:herschel[._-])?spire[._-]?(250|350|500)", "sedpy.herschel_spire_{}"),
        (r"(?:cfht[._-])?megacam[._-]([ugriz])", "megacam.{}"),
        (r"(?:cfht[._-])?wircam[._-](J)", "sedpy.cfht_wircam_{}_8101"),
        (r"(?:cfht[._-])?wircam[._-](H)", "sedpy.cfht_wircam_{}_8201"),
        (r"(?:cfht[._-])?wircam[._-](K)s?", "sedpy.cfht_wircam_{}s_8302"),
        (r"(?:ctio[._-]|blanco[._-])?(?:des|decam)[._-]([ugrizY])", "sedpy.decam_{}"),
        (r"(?:pan-?starrs1?|ps1|gpc1)[._-](?:ps1[._-]|gpc1[._-])?([grizy])", "sedpy.panstarrs_{}"),
        (r"(?:subaru[._-])?hsc[._-]([grizy])", "sedpy.hsc_{}"),
        (r"(?:mayall[._-]|kpno[._-])?newfirm[._-](J[123]|H[12]|K)", "newfirm.{}"),
        (
            r"(?:vista[._-]vircam|uvista|ultravista|vista|vircam|video|viking|vhs)[._-](Z|Y|J|H|Ks)",
            "sedpy.vista_vircam_{}",
        ),
        (r"(?:ukidss|ukirt|(?:ukirt[._-])?wfcam)[._-](J|H|K)", "sedpy.ukirt_wfcam_{}"),
        (r"(?:2mass|twomass)[._-](J|H|Ks)", "sedpy.twomass_{}"),
        (r"wise[._-]?w?([1-4])", "sedpy.wise_w{}"),
        (r"galex[._-](FUV|NUV)", "sedpy.galex_{}"),
        (r"sdss[._-]([ugriz])", "sedpy.sdss_{}0"),
    )
)


@cache
def _curves():
    return frozenset(path.stem for path in curve_folder().glob("*.par"))


def _is_here(name):
    if name.startswith(SEDPY):
        return name.removeprefix(SEDPY) in _curves()
    return name in Filter.names()


@cache
def filter_of_band(band):
    """
    Filter that a band of CIGALE is.

    Parameters
    ----------
    band : str
        A name of CIGALE's, such as ``IRAC1``, ``spitzer.irac.ch1`` or ``F770W``, one of ours, or the
        instrument and the band in any usual form (``VISTA_Ks``, ``decam.g``, ``newfirm_J1``).

    Returns
    -------
    name : str or None
        A name for `~miricigale.filters.Filter.from_name`; None if there is no such curve here.
    """
    if _is_here(band):
        return band
    if band in _NAMES:
        return _NAMES[band]
    name = _by_rule(band)
    if name is not None:
        return name
    for rule, ours in _FREE:
        match = rule.fullmatch(band)
        written = (match[1].lower(), match[1].upper(), match[1].capitalize()) if match else ()
        for name in map(ours.format, written):
            if _is_here(name):
                return name
    return None


def _by_rule(band):
    """Filter of a band by CIGALE's own names, as they are written there; None if there is none."""
    for rule, ours, _ in _COMPILED:
        match = rule.fullmatch(band)
        name = None if match is None else ours.format(match[1], match[1].lower())
        if name is not None and _is_here(name):
            return name
    return None


@cache
def cigale_band(name):
    """
    Band of CIGALE that a filter is.

    Parameters
    ----------
    name : str
        Name of a filter here.

    Returns
    -------
    band : str
        CIGALE's name; ``name`` itself where CIGALE has none that we know.
    """
    for band, ours in _NAMES.items():
        if ours == name and band.startswith(("herschel", "cfht")):
            return band
    for _, ours, back in _COMPILED:
        if back is None:
            continue
        start, _, end = re.sub(r"\{\d\}", "\0", ours).partition("\0")
        if name.startswith(start) and name.endswith(end) and len(name) > len(start) + len(end):
            part = name[len(start) : len(name) - len(end)]
            for written in dict.fromkeys((part, part.upper())):
                band = back.format(written)
                if _by_rule(band) == name:
                    return band
    return name


def is_line(band):
    """Whether a band is an emission line, in W/m2."""
    return band.startswith(("line.", "linefilter."))


def xray_energies(band):
    """Lowest and highest energy in keV of a band of CIGALE such as ``xray_boxcar_0p5to2keV``; None of others."""
    match = _XRAY.fullmatch(band)
    ends = match and tuple(float(text.replace("p", ".")) for text in match.groups())
    return ends if ends and 0 < ends[0] < ends[1] else None


def band_filters(bands, known):
    """
    Filters of bands: a dict of our name to CIGALE's, and the bands without a filter here.

    ``known`` are filters that the user gave by CIGALE's names, as `given_filters` has them. Emission lines
    have no filter; two bands of the same filter are a ValueError. X-ray bands (`xray_energies`) keep their names.
    """
    filters, lost = {}, []
    for band in bands:
        given = known.get(band)
        own = filter_of_band(band) or (band if xray_energies(band) else None)
        name = own if given is None else given.name
        name = None if is_line(band) else name
        if name is None:
            lost.append(band)
        elif name in filters:
            msg = f"the bands {filters[name]} and {band} are both the filter {name}"
            raise ValueError(msg)
        else:
            filters[name] = band
    return filters, lost


def given_filters(names):
    """
    Filters that a user gave for bands.

    Parameters
    ----------
    names : dict of str to `~miricigale.filters.Filter`, str or path-like, or None
        By the band's name a filter, the name of one here, or the path of its file (see `Filter.read`); the
        filter of a file has the name of the band.

    Returns
    -------
    filters : dict of str to `~miricigale.filters.Filter`

    Raises
    ------
    KeyError
        If there is no filter of a name.
    `~miricigale.utils.exceptions.DataError`
        If a file cannot be read as a filter.
    ValueError
        If a value is something else.
    """
    out = {}
    for band, given in (names or {}).items():
        if isinstance(given, Filter):
            out[band] = given
        elif isinstance(given, os.PathLike) or (isinstance(given, str) and _is_path(given)):
            out[band] = Filter.read(Path(given).expanduser(), name=band)
        elif isinstance(given, str):
            out[band] = Filter.from_name(filter_of_band(given) or given)
        else:
            wanted = f"a dict whose value for {band!r} is a Filter, the name of one or the path of its file"
            raise argument_error("names", wanted, type(given).__name__)
    return out


def _is_path(text):
    if filter_of_band(text) is not None:
        return False
    return os.sep in text or Path(text).suffix in (".dat", ".txt", ".par") or Path(text).is_file()
