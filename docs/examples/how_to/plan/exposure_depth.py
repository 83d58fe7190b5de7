"""
How deep is an exposure?
========================

You have an exposure time. You want the 5-sigma limit of point sources in each band, or the time that reaches a
limit.
"""

# %%
# ``sensitivity`` computes the limit from photons, dark current, read noise and background, as surveys in flight
# reach it; ``excess="ideal"`` is the limit of an ideal fit.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from miricigale.depth import sensitivity, sensitivity_table

for excess in ("flight", "ideal"):
    limit = sensitivity("F770W", 1 * u.h, excess=excess)
    print(f"F770W, one hour, {excess}: {limit:.2f}, {limit.to(u.ABmag):.2f}")

# %%
# All imaging filters in one hour in the aperture of the exposure time calculator, with its limits (version 4.0)
# scaled to that time:

table = sensitivity_table(time=1 * u.h)
table = table["filter", "background", "limit", "etc_40"]
table.round(2)
table

# %%
# The figure shows the limit against the exposure time. The limit falls with the square root of the time, as long
# as no systematic error remains.

times = np.logspace(2.5, 4.8, 7) * u.s
ax = plt.subplots(layout="constrained")[1]
for name, color in {"F770W": "C0", "F1500W": "C1", "F2100W": "C2"}.items():
    for excess, style in (("flight", "-"), ("ideal", "--")):
        limits = [sensitivity(name, t, excess=excess) for t in times]
        limits = u.Quantity(limits).to(u.ABmag)
        label = name if excess == "flight" else f"{name}, ideal"
        ax.semilogx(times, limits, style, color=color, label=label)
ax.set(xlabel="exposure time (s)", ylabel="5-sigma limit (AB)")
ax.invert_yaxis()
ax.legend(ncols=3, fontsize="small")
plt.show()

# %%
# The time to a limit follows from the square root. ``miricigale plan --depth 25.5`` solves it exactly.

wanted = 25.5 * u.ABmag
ratio = (sensitivity("F770W", 1 * u.h) / wanted.to(u.uJy)).value
print(f"time to {wanted}: {(ratio**2 * u.h).round(1)}")

# %%
# .. code-block:: console
#
#    $ miricigale plan --bands f770w f1500w --depth 25.5 24.0
#
# Limits of surveys are met within 0.15 mag in six of seven bands: see :doc:`/accuracy/planning`, and
# :doc:`/method/planning` for the errors of forced photometry.
