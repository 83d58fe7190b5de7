"""
Write the preset of COSMOS-Web's MIRI imaging, miricigale/workflow/presets/cosmosweb.toml.

    pip install pysiaf && python tools/make_cosmosweb.py

The 152 visits are a grid of 19 x 8 over 46.6' x 41.5' at a position angle of 20 degrees, each with eight exposures
of 257 s and MIRI in parallel (Casey et al. 2023, ApJ 954, 31). No list of the visits is published: here they are
evenly spaced about the center of COSMOS (Scoville et al. 2007, ApJS 172, 1), all with V3 at 110 degrees, where
the survey has taken a part of them half a year later with the opposite angle.
"""

from pathlib import Path

import astropy.units as u
import numpy as np
import pysiaf
from astropy.coordinates import SkyCoord

CENTER = SkyCoord("10h00m28.6s +02d12m21.0s")
V3PA, SHAPE, EXTENT = 110 * u.deg, (19, 8), (46.6, 41.5) * u.arcmin
#: Seconds of an exposure, and of a group in FASTR1.
EXPOSURE, GROUP = 257.0, 2.77504

HEAD = """\
# COSMOS-Web's MIRI imaging in F770W: 152 visits of eight exposures (Casey et al. 2023). Visits are evenly spaced
# over the published extent, and dithers are not NIRCam's: both of our own (tools/make_cosmosweb.py). It needs a
# catalog of COSMOS in [catalog] source. With --quick two dithers, as rates.
[run]
name = "cosmosweb"

[pointing]
roll = {roll:.1f}
centers = [
{centers}
]

[exposures]
filters = ["miri.f770w"]
n_groups = [{n_groups}]
n_integrations = [1]
n_dithers = [8]
dithers = ["cycling-large"]

[patches]
size = 100.0

[sed]
infrared = "fit"

[fit]
min_detected = 1
dust_excess = []

[point_sources]
enabled = false
"""


def visits():
    """Centers of MIRI's field at each visit, row by row."""
    nircam, miri = (
        pysiaf.Siaf(name).apertures[aperture].reference_point("tel")
        for name, aperture in (("NIRCam", "NRCALL_FULL"), ("MIRI", "MIRIM_FULL"))
    )
    v2, v3 = (np.array(miri) - np.array(nircam)) * u.arcsec
    steps = [
        (np.arange(n) - (n - 1) / 2) * extent / n for n, extent in zip(SHAPE, EXTENT, strict=True)
    ]
    for across in steps[1]:
        for along in steps[0]:
            # V3 points to its position angle, V2 90 degrees east of it
            north = (along + v3) * np.cos(V3PA) - (across + v2) * np.sin(V3PA)
            east = (along + v3) * np.sin(V3PA) + (across + v2) * np.cos(V3PA)
            yield CENTER.spherical_offsets_by(east, north)


def main():
    centers = ",\n".join(f'  "{one.ra.deg:.5f} {one.dec.deg:.5f}"' for one in visits())
    text = HEAD.format(roll=V3PA.value, centers=centers, n_groups=int(EXPOSURE / GROUP))
    folder = Path(__file__).parents[1] / "miricigale/workflow/presets"
    (folder / "cosmosweb.toml").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
