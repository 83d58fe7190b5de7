"""
Check errors with injected sources
==================================

You have measured an image. You want to know whether the errors are right on it: by sources of known flux,
injected into the image and the prior.
"""

# %%
# A simulated field and a photometer.

import astropy.units as u
import matplotlib.pyplot as plt

from miricigale import ForcedPhotometer
from miricigale.photometry import calibrate_errors, detect_sources
from miricigale.psf import MatchingKernel
from miricigale.scene import example_field

field = example_field(["F160W", "F770W"], size=16 * u.arcsec)
image, prior = field.images["miri.f770w"], field.images["wfc3.f160w"]
segments, sources = detect_sources(prior)
kernel = MatchingKernel.from_psfs(
    field.psfs["wfc3.f160w"], field.psfs["miri.f770w"], extent=6 * u.arcsec
)
photometer = ForcedPhotometer(kernel)

# %%
# Each trial injects copies of the prior's sources with new fluxes, measures all again, and adds as many empty
# places. Use more trials for your own image: a trial takes as long as a measurement.

inputs = (image, prior, segments, sources)
calibration = calibrate_errors(photometer, *inputs, n_trials=5, seed=1)
bins = calibration.bins["low", "high", "n", "mad", "bias", "factor", "factor_err"]
for name in ("low", "high", "mad", "bias", "factor", "factor_err"):
    bins[name].info.format = ".2f"
bins

# %%
# Multiply the errors by ``factor``; 1 means that they are right. With so few trials the factor is
# uncertain by ``factor_err``.

known = calibration.sources
pull = (known["flux"] - known["flux_true"]) / known["flux_err"]
snr = known["flux_true"] / known["flux_err_noise"]
fig, ax = plt.subplots(figsize=(6.4, 4), layout="constrained")
for kind in ("empty", "point", "galaxy"):
    rows = known["kind"] == kind
    ax.plot(snr[rows], pull[rows], "o", ms=4, label=kind)
ax.axhspan(-1, 1, color="0.9", zorder=0)
ax.set_xscale("symlog", linthresh=1)
ax.set(xlabel="true flux / error", ylabel="(measured - true) / error", ylim=(-5, 5))
ax.legend()
plt.show()

# %%
# ``apply`` multiplies the errors of a result.

result = calibration.apply(photometer.measure(*inputs))
result.to_table()["id", "flux", "flux_err"][:3]

# %%
# Injected galaxies are smooth profiles, so this does not test spiral arms and clumps. See
# :doc:`/method/photometry_errors` and :doc:`/accuracy/photometry`.
