"""
Switch on one detector effect
=============================

You want to see what an effect of the detector does to the counts, or which of them a reduction has to deal with.
"""

# %%
# A detector is a tuple of effects in their order. ``Detector.miri_imager()`` has the standard ones; optional
# effects are given to it, and ``without`` takes effects out.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.nddata import CCDData
from astropy.table import Table

from miricigale import Detector, Exposure
from miricigale.detector import (
    ADConversion,
    BadPixels,
    Bias,
    CosmicRays,
    FirstFrame,
    InterpixelCapacitance,
    LastFrame,
    Nonlinearity,
    Photons,
    ReadNoise,
    ResetAnomaly,
    Residual,
)

standard = Detector.miri_imager()
Table({"effects of miri_imager": [type(e).__name__ for e in standard.effects]})

# %%
# Take a noise-free star on a flat sky, and a plain detector that turns light into counts. Add one effect to the
# plain detector at a time. Every effect has a random stream of its own, so that the photons stay the same,
# except in rows in which an effect changes the light itself.

exposure = Exposure(
    "F1000W",
    n_groups=20,
    subarray="SUB64",
    pointing="53.13 -27.83",
    roll=0 * u.deg,
)
y, x = np.mgrid[:64, :72]
light = 12 + 3e3 * np.exp(-((x - 36) ** 2 + (y - 32) ** 2) / 8)
sky = CCDData(light, unit="MJy/sr")
linear = Nonlinearity(linear=True)
plain = Detector((Photons(flat=False), linear, Bias(), ADConversion()))
reference = plain.expose(sky, exposure, seed=1).data[0].astype(float)

added = [
    Residual(0.02),
    Photons(flat=True),
    InterpixelCapacitance(),
    CosmicRays(flux=2e-6),
    BadPixels(hot_current=3000),
    Nonlinearity(),
    ReadNoise(),
    ReadNoise(pink=6.0),
]
fig, axes = plt.subplots(2, 4, figsize=(10, 5), layout="constrained")
for ax, effect in zip(axes.flat, added, strict=True):
    counts = plain.replace(effect).expose(sky, exposure, seed=1).data[0]
    change = counts[-1] - reference[-1]
    scale = np.percentile(np.abs(change), 98) + 1
    limits = {"vmin": -scale, "vmax": scale}
    image = ax.imshow(change, origin="lower", cmap="RdBu_r", **limits)
    fig.colorbar(image, ax=ax, shrink=0.7)
    note = " with 1/f" if getattr(effect, "pink", 0) else ""
    ax.set_title(type(effect).__name__ + note, fontsize=9)
    ax.set_axis_off()
fig.suptitle("change of the last group (DN)")
plt.show()

# %%
# Effects of resets change the groups, not the image: they are drawn over time, for an empty pixel.

fig, ax = plt.subplots(figsize=(7, 3.5), layout="constrained")
for effect in (ResetAnomaly(), FirstFrame(), LastFrame()):
    counts = plain.replace(effect).expose(sky, exposure, seed=1).data[0]
    change = (counts - reference).mean(axis=(1, 2))
    ax.plot(np.arange(1, 21), change, "o-", label=type(effect).__name__)
ax.set(xlabel="group", ylabel="mean change (DN)")
ax.legend()
plt.show()

# %%
# See :doc:`/method/detector` for the order of the effects, :doc:`/method/detector_effects` for their equations,
# and :doc:`/developers/add_effect` for writing your own.
