"""
Find out what the flags mean
============================

You have a table of fluxes with a column ``flags``. You want to know what the numbers mean, how often each
occurs, and which sources to leave out.
"""

# %%
# A simulated field. A stripe of the image is masked, and the catalog has ten positions without a source on the
# prior, as those of an X-ray catalog may be.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table, vstack

from miricigale import ForcedPhotometer
from miricigale.photometry import ForcedFlags, detect_sources
from miricigale.scene import example_field

field = example_field(["F160W", "F1000W"], size=20 * u.arcsec)
image, prior = field.images["miri.f1000w"], field.images["wfc3.f160w"]
photometer = ForcedPhotometer(
    psf=field.psfs["miri.f1000w"],
    highres_psf=field.psfs["wfc3.f160w"],
)
image.mask = np.zeros(image.shape, bool)
image.mask[70:80] = True
segments, sources = detect_sources(prior)
x, y = np.random.default_rng(3).uniform(5, image.shape[0] - 6, (2, 10))
more = QTable({"sky": SkyCoord.from_pixel(x, y, image.wcs)})
catalog = vstack([sources[["sky"]], more])
result = photometer.measure(image, prior, segments, catalog)

# %%
# All flags, their meaning, and how many sources have them. Flags are bits: 96 is 32 + 64.

rows = [
    (value, name, np.count_nonzero(result.flags & value), text)
    for value, (name, text) in ForcedFlags.meanings().items()
]
Table(rows=rows, names=["value", "name", "sources", "meaning"])

# %%
# The names of one number, and the flags of each source:

print(ForcedFlags.names(96))
result.flag_names()[:4]

# %%
# Sources to use: measured, not at the edge, with a good fit. Flags such as NO_SEGMENT and NOISY_SEGMENT only
# say that the template is a point.

bad = ForcedFlags.EDGE | ForcedFlags.MASKED | ForcedFlags.POOR_FIT
bad |= ForcedFlags.UNEXPLAINED_NEIGHBOR
bad |= ForcedFlags.NO_DATA | ForcedFlags.DEGENERATE
good = result[(result.flags & int(bad)) == 0]
print(f"{len(good)} of {len(result)} sources")

# %%

fig, ax = plt.subplots(figsize=(6, 5.4), layout="constrained")
ax.imshow(
    np.ma.array(image.data, mask=image.mask),
    origin="lower",
    cmap="gray_r",
    vmin=-0.1,
    vmax=0.5,
)
marks = {"EDGE": "s", "NO_SEGMENT": "o", "NOISY_SEGMENT": "D", "MASKED": "X"}
for k, (name, mark) in enumerate(marks.items()):
    rows = (result.flags & int(ForcedFlags[name])) > 0
    ax.plot(
        result.x[rows],
        result.y[rows],
        mark,
        ms=11,
        mfc="none",
        mew=1.5,
        mec=f"C{k}",
        label=name,
    )
ny, nx = image.shape
ax.set(
    xlim=(-0.5, nx - 0.5),
    ylim=(-0.5, ny - 0.5),
    xlabel="x (pixels)",
    ylabel="y (pixels)",
)
ax.legend(loc="upper left")
plt.show()

# %%
# The description of the column in every table that is written repeats the meanings. See
# :doc:`/method/photometry_errors` for POOR_FIT and UNEXPLAINED_NEIGHBOR.
