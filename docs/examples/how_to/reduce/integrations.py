"""
Fit the slopes of each integration
==================================

You have an exposure of several integrations. You want a slope image of each, to look for variability or for
trouble in the first integrations.
"""

# %%
# Five integrations of a star, with what resets do to the ramps of MIRI.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.nddata import CCDData
from astropy.table import Table

from miricigale import Detector, Exposure, Reducer
from miricigale.detector import ResetAnomaly
from miricigale.reduction import write_image

exposure = Exposure(
    "F1000W",
    n_groups=20,
    n_integrations=5,
    subarray="SUB64",
    pointing="53.13 -27.83",
    roll=0 * u.deg,
)
y, x = np.mgrid[:64, :72]
light = 12 + 800 * np.exp(-((x - 36) ** 2 + (y - 32) ** 2) / 6)
sky = CCDData(light, unit="MJy/sr")
anomaly = ResetAnomaly(amplitudes=(-60.0, -20.0))
ramp = Detector.miri_imager(anomaly).expose(sky, exposure, seed=3)

# %%
# ``fit_integrations`` gives an image for each integration. The anomaly, which is larger in the first, must be
# given to be subtracted; without it there is a warning. If only half of it is given, slopes are too high, most
# of all in the first integration.

right = Reducer(reset_anomaly=anomaly).fit_integrations(ramp)
half = ResetAnomaly(amplitudes=(-30.0, -10.0))
wrong = Reducer(reset_anomaly=half).fit_integrations(ramp)

fig, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
for rates, label in ((right, "anomaly subtracted"), (wrong, "half of it")):
    levels = [np.nanmedian(rate.data) for rate in rates]
    axes[0].plot(range(1, 6), levels, "o-", label=label)
axes[0].set(xlabel="integration", ylabel="median slope (DN/s)")
axes[0].legend()
difference = right[0].data - right[4].data
options = {"vmin": -15, "vmax": 15, "cmap": "coolwarm"}
image = axes[1].imshow(difference, origin="lower", **options)
axes[1].set_title("integration 1 minus 5", fontsize=10)
fig.colorbar(image, ax=axes[1], label="DN/s")
plt.show()

# %%
# The mean of the integrations agrees with the fit to all of them, whose errors are smaller.

together = Reducer(reset_anomaly=anomaly).fit_ramp(ramp)
rows = [
    ("one integration", np.nanmedian(right[0].uncertainty.array).round(3)),
    ("all five", np.nanmedian(together.uncertainty.array).round(3)),
]
Table(rows=rows, names=["fit", "median error (DN/s)"])

# %%
# A list is written as a ``_rateints`` file, with the variances of photons and of the read-out:

planes = Reducer(reset_anomaly=anomaly).fit_integrations(ramp, planes=True)
print(write_image(planes, "star_rateints.fits", overwrite=True))

# %%
# The command does it with ``miricigale reduce FILES --rateints -o DIR``. See :doc:`/method/reduction_slopes`,
# and :doc:`/method/detector_effects` for the effects of resets.
