"""
Make ``catalog.goodss``: real galaxies around the MIRI field of the GOODS-S study.

The 3D-HST v4.1 GOODS-S catalog, with van der Wel et al. (2012) GALFIT fits and model
magnitudes in JWST's bands, comes inside the mirage wheel::

    pip download --no-deps mirage==2.5.0
    python tools/make_catalog.py mirage-2.5.0-py3-none-any.whl

Everything that the source catalog marks as missing or that cannot be right is taken out
by the rules below, each a named function that is counted and printed; what a rule touched
is written in the column ``quality``.
"""

import argparse
import gzip
import hashlib
import io
import zipfile
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table

MEMBER = "mirage/config/goodss_3dhst.v4.1.jwst_galfit.cat"
TARGET = Path(__file__).parents[1] / "miricigale/refdata/files/catalog/goodss.ecsv.gz"

#: Centre of the MIRI imager's field in the study of GOODS-S.
CENTER = SkyCoord(53.13440 * u.deg, -27.83444 * u.deg)
#: The imager's 74" x 113" fits in a circle of 67.5"; the rest is margin for dithers and wings,
#: and takes the whole 1032 x 1024 array in (its farthest corner lies at 94"). A circle holds
#: for any roll of the telescope.
RADIUS = 95 * u.arcsec
FAINT_LIMIT = 26.6  # F160W, AB

#: Bands of the catalog between 0.7 and 4.8 um that have a filter curve (no narrow bands).
BANDS = (
    *("f070w", "f090w", "f115w", "f140m", "f150w", "f150w2", "f162m", "f182m", "f200w", "f210m"),
    *("f250m", "f277w", "f300m", "f322w2", "f335m", "f356w", "f360m", "f410m", "f430m", "f444w"),
    *("f460m", "f480m"),
)
#: Model magnitudes outside are fill values or failed models.
MAGNITUDE_LIMITS = (10.0, 40.0)
#: Model colors (band - F160W) outside are failed models or sources blended in IRAC.
COLOUR_LIMITS = (-2.5, 5.0)

#: A Sersic profile is used only within these.
MAX_GALFIT_FLAG = 1
MIN_AXIS_RATIO = 0.1
MAX_RADIUS = 3.0  # arcsec
SERSIC_FAINT_LIMIT = 24.5  # F160W, AB
MISSING_REDSHIFT = (-99.9, -1.0, 0.0)

QUALITY = {
    "magnitude_absurd": 1,
    "colour_absurd": 2,
    "point_by_galfit_flag": 4,
    "point_by_axis_ratio": 8,
    "point_by_radius": 16,
    "point_by_faintness": 32,
    "star": 64,
}


def read_source(wheel):
    """The catalog inside the wheel, as it is."""
    with zipfile.ZipFile(wheel) as archive:
        text = archive.read(MEMBER).decode()
    return Table.read(text, format="ascii.commented_header")


def f160w_magnitude(source):
    """AB magnitude by the catalog's flux, whose zero point is 25 ('mag' is GALFIT's own)."""
    return 25.0 - 2.5 * np.log10(np.asarray(source["f_F160W"], dtype=float))


def select(source, radius, faint):
    """Rows in the circle and brighter than the limit."""
    sky = SkyCoord(source["ra"], source["dec"], unit="deg")
    return (sky.separation(CENTER) < radius) & (f160w_magnitude(source) < faint)


def redshifts(source, star):
    """Spectroscopic where there is one (-99.9, -1 and 0 say there is none), else photometric."""
    spec = np.asarray(source["z_spec"], dtype=float)
    has_spec = ~np.isin(spec, MISSING_REDSHIFT) & (spec > 0)
    redshift = np.where(has_spec, spec, np.asarray(source["z_phot"], dtype=float))
    kind = np.where(has_spec, "spec", "phot")
    return np.where(star, np.nan, redshift), np.where(star, "star", kind)


def main():
    """Write the catalog and print what each rule did."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--output", type=Path, default=TARGET)
    args = parser.parse_args()

    source = read_source(args.wheel)
    source = source[select(source, RADIUS, FAINT_LIMIT)]
    source.sort("id")
    n = len(source)
    mag = f160w_magnitude(source)
    quality = np.zeros(n, dtype=int)
    counts = {}

    def rule(name, mask):
        quality[mask] |= QUALITY[name]
        counts[name] = int(np.count_nonzero(mask))

    # star_flag 2 means too faint to tell: kept as a galaxy
    star = np.asarray(source["star_flag"]) == 1
    rule("star", star)
    redshift, kind = redshifts(source, star)

    flag = np.asarray(source["f"])
    ratio = np.asarray(source["q"], dtype=float)
    size = np.asarray(source["re"], dtype=float)
    bad_fit = (flag > MAX_GALFIT_FLAG) | star
    thin = ~bad_fit & (ratio < MIN_AXIS_RATIO)
    large = ~bad_fit & ((size > MAX_RADIUS) | (size <= 0))
    faint = ~(bad_fit | thin | large) & (mag > SERSIC_FAINT_LIMIT)
    rule("point_by_galfit_flag", flag > MAX_GALFIT_FLAG)
    rule("point_by_axis_ratio", thin)
    rule("point_by_radius", large)
    rule("point_by_faintness", faint)
    sersic = ~(bad_fit | thin | large | faint)

    def shape(name, fill):
        return np.where(sersic, np.asarray(source[name], dtype=float), fill)

    flux160 = np.asarray(source["f_F160W"], dtype=float) * 10 ** (-0.4 * (25.0 - 23.9))
    table = QTable()
    table["id"] = np.asarray(source["id"], dtype=int)
    table["sky"] = SkyCoord(source["ra"], source["dec"], unit="deg")
    table["redshift"] = redshift
    table["redshift_source"] = kind
    table["star"] = star
    table["profile"] = np.where(sersic, "sersic", "point")
    table["half_light_radius"] = shape("re", 0.0) * u.arcsec
    table["sersic_index"] = shape("n", np.nan)
    table["axis_ratio"] = shape("q", 1.0)
    # north through east in the source, in (-90, 90]: the same convention
    table["position_angle"] = shape("pa", 0.0) * u.deg
    table["galfit_flag"] = flag.astype(int)
    table["mag_f160w"] = np.round(mag, 3) * u.ABmag
    table["wfc3.f160w"] = np.array([float(f"{v:.5g}") for v in flux160]) * u.uJy
    absurd, colour = np.zeros((2, n), dtype=bool)
    for band in BANDS:
        value = np.asarray(source[f"mag_nircam-{band}"], dtype=float)
        wild = ~((value > MAGNITUDE_LIMITS[0]) & (value < MAGNITUDE_LIMITS[1]))
        low, high = COLOUR_LIMITS
        tail = ~wild & ~((value - mag > low) & (value - mag < high))
        absurd |= wild
        colour |= tail
        flux = np.where(wild | tail, np.nan, 10 ** (-0.4 * (value - 23.9)))
        table[f"nircam.{band}"] = np.array([float(f"{v:.4g}") for v in flux]) * u.uJy
        if np.any(wild | tail):
            print(f"  nircam.{band}: {wild.sum()} magnitudes absurd, {tail.sum()} colors absurd")
    rule("magnitude_absurd", absurd)
    rule("colour_absurd", colour)
    table["quality"] = quality

    table["redshift_source"].info.description = "spec, phot, or star (redshift NaN)"
    table["wfc3.f160w"].info.description = "measured total flux; nircam columns are model fluxes"
    bits = ", ".join(f"{bit} {name}" for name, bit in QUALITY.items())
    table["quality"].info.description = f"rules that touched the row (bits): {bits}"
    table.meta = {
        "title": f"3D-HST GOODS-S v4.1, F160W < {FAINT_LIMIT}, within {RADIUS.value:g} arcsec",
        "center": [CENTER.ra.deg, CENTER.dec.deg],
        "radius_arcsec": float(RADIUS.value),
        "citations": ["Skelton et al. 2014", "van der Wel et al. 2012", "Momcheva et al. 2016"],
    }
    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    args.output.parent.mkdir(parents=True, exist_ok=True)
    payload = gzip.compress(text.getvalue().encode(), 9, mtime=0)
    args.output.write_bytes(payload)

    print(f"{n} rows; {sersic.sum()} Sersic, {n - sersic.sum()} points; {star.sum()} stars")
    print(
        f"redshifts: {np.sum(kind == 'spec')} spectroscopic, {np.sum(kind == 'phot')} photometric"
    )
    for name, count in counts.items():
        print(f"  rule {name}: {count}")
    print(f"{args.output}: {len(payload)} bytes, sha256 {hashlib.sha256(payload).hexdigest()}")


if __name__ == "__main__":
    main()
