"""
Choose a threshold by purity
============================

You have detected sources and want to know which share of them is real (purity, false detections), as a
function of signal-to-noise, to choose the threshold.
"""

# %%
# A simulated F444W image and three thresholds, in units of the noise of a pixel.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from miricigale.photometry import detect_sources, detection_purity
from miricigale.plotting.images import plot_segmentation
from miricigale.scene import example_field

image = example_field(["F444W"], size=30 * u.arcsec).images["nircam.f444w"]
thresholds = (0.3, 0.5, 1.0)
edges = [1, 2, 3, 4, 5, 7, 10, 20, 50]

# %%
# ``detection_purity`` detects on the image and on its negative with the same settings. Noise makes as many
# detections on both; sources make none on the negative.

options = {"preset": "default", "snr_edges": edges}
tables = {t: detection_purity(image, threshold=t, **options) for t in thresholds}
table = tables[0.5]["snr_low", "n_positive", "n_negative", "purity", "purity_above"]
for name in ("purity", "purity_above"):
    table[name].info.format = ".2f"
table

# %%

fig, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.2), layout="constrained")
segments, sources = detect_sources(image, preset="default", threshold=0.5)
plot_segmentation(image.data, segments.data, ax=left, pixel_scale=0.06)
left.set_title(f"threshold 0.5: {len(sources)} detections")
for t, purity in tables.items():
    n = purity.meta["n_positive"]
    right.plot(
        purity["snr_low"],
        purity["purity_above"],
        "o-",
        label=f"threshold {t}, {n} detections",
    )
right.set(xscale="log", xlabel="least signal-to-noise", ylabel="purity above it")
right.legend()
plt.show()

# %%
# Keep what is pure enough:

limit = next(row["snr_low"] for row in tables[0.5] if row["purity_above"] > 0.95)
kept = sources[np.asarray(sources["snr"]) > limit]
print(f"{len(kept)} of {len(sources)} detections above S/N = {limit:.0f}")

# %%
# Use the same settings for the prior: ``measure(image, highres, segments, sources)``. Cosmic rays that are left
# are not seen by this test. See :doc:`/method/photometry`.
