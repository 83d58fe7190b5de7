"""
Simulate a scene of your catalog
================================

You have a catalog of galaxies with fluxes and shapes. You want the noiseless image that MIRI would take of them,
as the input of a simulated exposure.
"""

# %%
# Here a small CSV file stands for the catalog. Its columns have names of their own, and its fluxes a zero point
# of 25.

from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt

from miricigale import Exposure
from miricigale.scene import Scene, read_catalog

Path("mine.csv").write_text(
    """NUMBER,ALPHA,DELTA,z,FLUX_77,type,re,n,q,pa
1,53.1300,-27.8300,0.7,60,sersic,0.8,1.0,0.4,20
2,53.1320,-27.8310,1.9,25,sersic,0.3,3.1,0.8,75
3,53.1280,-27.8315,1.1,40,sersic,0.5,1.5,0.6,130
4,53.1310,-27.8283,2.4,12,point,,,,
5,53.1285,-27.8290,0.9,150,sersic,0.4,4.0,0.9,0
"""
)

# %%
# Say which column is what, and give the units that the file does not state. Number 4 is a point. Without a
# column of profiles, sources without a complete shape become points, with a warning.

catalog = read_catalog(
    "mine.csv",
    columns={
        "id": "NUMBER", "ra": "ALPHA", "dec": "DELTA", "redshift": "z",
        "miri.f770w": "FLUX_77", "half_light_radius": "re", "sersic_index": "n",
        "axis_ratio": "q", "position_angle": "pa", "profile": "type",
    },
    units={"flux": "0.3631 uJy", "half_light_radius": "arcsec"},
)  # fmt: skip
catalog["miri.f770w"].info.format = ".2f"
catalog["id", "redshift", "miri.f770w", "profile"]

# %%
# The exposure says where the telescope looks. The scene has its grid, its distortion and its PSF.

exposure = Exposure(
    "F770W",
    time=10 * u.min,
    subarray="SUB256",
    pointing="53.130 -27.830",
    roll=40 * u.deg,
)
scene = Scene(catalog, exposure, background="low")
scene.plot()
plt.show()

# %%
# ``scene.truth`` says what is in the image: where each source is, and how much of its flux.

truth = scene.truth
for name in ("x", "y", "flux_total", "flux_in_image"):
    truth[name].info.format = ".2f"
truth["id", "x", "y", "profile", "flux_total", "flux_in_image"]

# %%
# ``scene.render()`` is the image in MJy/sr, which ``Detector.miri_imager().expose(scene)`` takes. A table in
# memory, a ``dict`` or a pandas ``DataFrame`` may replace the file: ``Scene(table, exposure)``.
#
# See :doc:`/method/scene_catalog` for all columns, and :doc:`/accuracy/scene` for the accuracy of the painted
# profiles.
