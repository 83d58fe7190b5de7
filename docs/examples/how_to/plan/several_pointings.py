"""
Cover a field with several pointings
====================================

Your field is larger than the imager. You want a mosaic of several pointings, its exposure time over the sky, and
the area that several bands share.
"""

# %%
# Three pointings side by side and two above each other, neighbors overlap by a tenth. F1500W gets two dithers in
# place of three.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.coordinates import SkyCoord
from matplotlib.path import Path

from miricigale.workflow import load_config
from miricigale.workflow.stages.exposures import study_exposures

overrides = {
    "pointing": {"tiles": [3, 2], "overlap": 0.1},
    "exposures": {"filters": ["miri.f770w", "miri.f1500w"], "n_dithers": [3, 2]},
    "fit": {"min_detected": 2},
}
config = load_config("goodss", overrides=overrides)
exposures = study_exposures(config).values()
print(len(exposures), "exposures")

# %%
# The exposure time on a grid of positions, from the corners of each exposure:

center = SkyCoord(config.pointing.ra, config.pointing.dec, unit="deg")
step = 1.5
x = np.arange(-180, 180, step)
offsets = np.meshgrid(x, x) * u.arcsec
sky = center.spherical_offsets_by(*offsets)
positions = np.column_stack([sky.ra.deg.ravel(), sky.dec.deg.ravel()])
time = {}
for exposure in exposures:
    footprint = Path(exposure.wcs.calc_footprint())
    seen = footprint.contains_points(positions).reshape(sky.shape)
    seconds = seen * exposure.exposure_time.to_value(u.s)
    time[exposure.filter] = time.get(exposure.filter, 0) + seconds

figure, axes = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
for ax, (name, image) in zip(axes, time.items(), strict=True):
    picture = ax.pcolormesh(x, x, image, cmap="viridis")
    ax.set(title=name, aspect="equal", xlabel="east (arcsec)", xlim=(180, -180))
    figure.colorbar(picture, ax=ax, label="exposure time (s)")
plt.show()

# %%
# The area of each band, of both, and of both with at least two dithers:

pixel = (step / 60) ** 2
both = np.all([image > 0 for image in time.values()], axis=0)
twice = np.all([t > 1.5 * t[t > 0].min() for t in time.values()], axis=0)
for name, image in time.items():
    print(f"{name:12} {np.sum(image > 0) * pixel:5.1f} arcmin2")
print(f"{'both':12} {np.sum(both) * pixel:5.1f} arcmin2")
print(f"{'both, twice':12} {np.sum(twice) * pixel:5.1f} arcmin2")

# %%
# ``Reducer.mosaic`` puts images of any number of pointings on one grid (``instrument.mosaic_wcs`` makes it). The
# commands:
#
# .. code-block:: console
#
#    $ miricigale run goodss --set 'pointing.tiles=[3, 2]'
#    $ miricigale run goodss --set 'pointing.tiles=[3, 2]' --set patches.size=100 --plan
#    $ miricigale plan --bands f770w f1500w --time 1500 --pointings 6
#
# See :doc:`/method/workflow_truth` for how errors follow the exposure time at each source.
