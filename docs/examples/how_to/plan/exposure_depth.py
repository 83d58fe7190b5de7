"""
How deep is an exposure?
========================

You have an exposure time. You want the 5-sigma limit of point sources in each band, as from the exposure time
calculator (ETC), or the time that reaches a limit.
"""

# %%
# ``sensitivity`` computes the limit of aperture photometry from photons, dark current, read noise and background.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from miricigale.depth import scaled_limit, sensitivity, sensitivity_table

limit = sensitivity("F770W", 1 * u.h, n_sigma=5)
print(f"F770W, one hour: {limit:.2f}, {limit.to(u.ABmag):.2f}")

# %%
# All imaging filters in one hour, with the limits of the calculator (version 4.0) scaled to that time:

table = sensitivity_table(time=1 * u.h, n_sigma=5)
table = table["filter", "background", "limit", "etc_40"]
table.round(2)
table

# %%
# The limit by time. It falls with the square root of the time, as long as nothing systematic remains. The option
# ``residual="etc"`` adds the pattern of flat field and sky that the calculator allows for.

times = np.logspace(2.5, 4.8, 7) * u.s
ax = plt.subplots(layout="constrained")[1]
for name, color in {"F770W": "C0", "F1500W": "C1", "F2100W": "C2"}.items():
    for residual, style in ((None, "-"), ("etc", "--")):
        limits = [sensitivity(name, t, n_sigma=5, residual=residual) for t in times]
        limits = u.Quantity(limits).to(u.ABmag)
        label = name if residual is None else f"{name}, residual"
        ax.semilogx(times, limits, style, color=color, label=label)
ax.set(xlabel="exposure time (s)", ylabel="5-sigma limit (AB)")
ax.invert_yaxis()
ax.legend(ncols=3, fontsize="small")
plt.show()

# %%
# The time to a limit follows from the square root. ``miricigale plan --depth 25.5`` solves it exactly.

wanted = 25.5 * u.ABmag
ratio = (scaled_limit("F770W", 1 * u.h) / wanted.to(u.uJy)).value
print(f"time to {wanted}: {(ratio**2 * u.h).round(1)}")

# %%
# .. code-block:: console
#
#    $ miricigale plan --bands f770w f1500w --depth 25.5 24.0
#
# With the noise of plans (``[noise] excess``) the limits of surveys are met within 0.15 mag in six of seven bands:
# see :doc:`/accuracy/planning`, and :doc:`/method/planning` for the errors of forced photometry.
