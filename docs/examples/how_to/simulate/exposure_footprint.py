"""
Set time, footprint and dithers
===============================

You know the field, the filter and how long you want to observe. You want groups and integrations, the footprint
on the sky, and dithers.
"""

# %%
# An `~miricigale.instrument.Exposure` takes a time, and splits it into groups and integrations such that the sky
# does not fill the detector. F770W needs one integration for ten minutes, F2100W several.

import astropy.units as u
import matplotlib.pyplot as plt
from astropy.table import Table

from miricigale import Exposure

field = {"pointing": "53.1344 -27.8344", "roll": 35 * u.deg}
names = ("F770W", "F1500W", "F2100W")
exposures = [Exposure(name, time=10 * u.min, **field) for name in names]
Table(
    {
        "filter": [e.filter for e in exposures],
        "groups": [e.n_groups for e in exposures],
        "integrations": [e.n_integrations for e in exposures],
        "time": u.Quantity([e.exposure_time for e in exposures]).round(1),
        "duration": u.Quantity([e.duration for e in exposures]).round(1),
    }
)

# %%
# Dithers are copies of the exposure with shifted pointings.

dithers = exposures[0].dithered("cycling-large", 8)
Table(
    {
        "dither": [e.dither for e in dithers],
        "ra": [round(e.pointing.ra.deg, 5) for e in dithers],
        "dec": [round(e.pointing.dec.deg, 5) for e in dithers],
    }
)

# %%
# The WCS of each exposure gives its footprint. Columns before 359 of the full frame lie behind the masks of the
# coronagraphs and see no sky through the imaging filters.

fig, ax = plt.subplots(figsize=(6, 5), layout="constrained")
for exposure in dithers:
    x, y = [359, 1027, 1027, 359, 359], [0, 0, 1023, 1023, 0]
    sky = exposure.wcs.pixel_to_world(x, y)
    ax.fill(sky.ra, sky.dec, color="C0", alpha=0.12)
    ax.plot(sky.ra, sky.dec, "C0", lw=0.7)
    ax.plot(exposure.pointing.ra, exposure.pointing.dec, "k+")
ax.set(xlabel="right ascension (deg)", ylabel="declination (deg)")
ax.invert_xaxis()
ax.set_aspect(1.13)
plt.show()

# %%
# Other patterns are ``"ceers"``, ``"4-point"``, ``"cycling-small"`` and ``"cycling-medium"``; your own offsets
# may be an array in arcsec, a table, or the ``.pointing`` file that APT exports
# (`~miricigale.instrument.read_dithers`).
#
# See :doc:`/method/instrument` for pointing, roll and distortion.
