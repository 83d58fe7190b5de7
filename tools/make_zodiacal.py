"""
Make the table of the zodiacal light by ecliptic latitude.

    pip install zodipy && python tools/make_zodiacal.py

Writes miricigale/refdata/files/instrument/zodiacal.ecsv and prints its checksum for resources.toml.
The light is that of the model of Kelsall et al. 1998 (ZodiPy, "dirbe") at the pivot wavelengths, for an
observer at L2, on the days of a year on which a position is 85 to 135 degrees from the Sun, where the
telescope may look; percentiles are over days and four ecliptic longitudes. Rows "sky" are percentiles
over the whole sky, each latitude with its area. Values are over the low zodiacal light of the package.
"""

import hashlib
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
import zodipy
from astropy.coordinates import BarycentricMeanEcliptic, SkyCoord, get_sun
from astropy.table import Table
from astropy.time import Time

from miricigale.filters import Filter
from miricigale.instrument import background_level, imager_filters

OUT = Path(__file__).parents[1] / "miricigale/refdata/files/instrument/zodiacal.ecsv"
LATITUDES = (0, 5, 10, 15, 20, 25, 30, 35, 40, 45, 50, 60, 70, 80, 90)
LONGITUDES = (0, 90, 180, 270)
LEVELS = {"low": 10, "medium": 50, "high": 90}
DAYS = Time("2026-01-01") + np.arange(0, 365, 3.65) * u.day


def visible():
    """Latitude and position of every day on which one of the places can be seen."""
    sun = get_sun(DAYS)
    sun = SkyCoord(sun.ra, sun.dec)
    latitudes, places, days = [], [], []
    for latitude in LATITUDES:
        for longitude in LONGITUDES:
            place = (longitude, min(latitude, 89.9))
            position = SkyCoord(*place, unit="deg", frame=BarycentricMeanEcliptic).icrs
            angle = position.separation(sun).deg
            seen = np.flatnonzero((angle > 85) & (angle < 135))
            latitudes += [latitude] * len(seen)
            places += [place] * len(seen)
            days += list(seen)
    order = np.argsort(days, kind="stable")
    lon, lat = np.transpose(places)[:, order]
    day = DAYS[np.array(days)[order]]
    frame = {"unit": "deg", "frame": BarycentricMeanEcliptic, "obstime": day}
    return np.array(latitudes)[order], SkyCoord(lon, lat, **frame)


def main():
    warnings.simplefilter("ignore")
    names = imager_filters()
    models = [zodipy.Model(Filter.from_name(name).pivot) for name in names]
    low = [(background_level(n) - background_level(n, zodi="none")).value for n in names]
    latitudes, positions = visible()
    light = np.array([m.evaluate(positions, obspos="semb-l2").value for m in models])
    by_latitude = {latitude: light[:, latitudes == latitude] for latitude in LATITUDES}
    table = Table(names=("latitude", "level", *names), dtype=(float, "U6", *(float,) * len(names)))
    for latitude, values in by_latitude.items():
        for level, share in LEVELS.items():
            factors = np.percentile(values, share, axis=1) / low
            table.add_row((latitude, level, *np.round(factors, 3)))
    # the whole sky: each latitude stands for the ring half way to its neighbors
    edges = np.concatenate([[0], (np.array(LATITUDES[1:]) + LATITUDES[:-1]) / 2, [90]])
    area = np.diff(np.sin(np.radians(edges)))
    values = np.concatenate(list(by_latitude.values()), axis=1)
    counts = [v.shape[1] for v in by_latitude.values()]
    weights = np.repeat(area / counts, counts)
    for level, share in LEVELS.items():
        factors = [
            np.percentile(v, share, weights=weights, method="inverted_cdf") / one
            for v, one in zip(values, low, strict=True)
        ]
        table.add_row((np.nan, level, *np.round(factors, 3)))
    table["latitude"].unit = "deg"
    table["latitude"].info.description = "ecliptic, without sign; NaN: the whole sky"
    table["level"].info.description = "percentile of the days: low 10, medium 50, high 90"
    table.write(OUT, format="ascii.ecsv", overwrite=True)
    print(hashlib.sha256(OUT.read_bytes()).hexdigest())


if __name__ == "__main__":
    main()
