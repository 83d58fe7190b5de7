"""
Measure your own MIRI mosaic
============================

You have a MIRI mosaic, an image of higher resolution, and their PSFs. You want the flux of every source, with
errors that include the correlated noise and the blending.
"""

# %%
# Here a simulated field stands for the files. Its images are written as a reduction would leave them: surface
# brightness in MJy/sr, an uncertainty, and a WCS.

import astropy.units as u
import matplotlib.pyplot as plt

from miricigale import ForcedPhotometer
from miricigale.scene import example_field

field = example_field(["F160W", "F770W"], size=20 * u.arcsec)
field.images["miri.f770w"].write("f770w.fits", overwrite=True)
field.images["wfc3.f160w"].write("f160w.fits", overwrite=True)

# %%
# A photometer needs the two PSFs: files, arrays or photutils models. It makes the matching kernel itself.
# Sources are detected on the image of high resolution unless a segmentation map or a catalog is given.

photometer = ForcedPhotometer(
    psf=field.psfs["miri.f770w"],
    highres_psf=field.psfs["wfc3.f160w"],
)
result = photometer.measure("f770w.fits", "f160w.fits")

table = result.to_table()["id", "flux", "flux_err", "snr", "flags"]
for name, form in {"flux": ".3f", "flux_err": ".3f", "snr": ".1f"}.items():
    table[name].info.format = form
table[:6]

# %%
# The residual shows what the sources do not explain. It should look like noise.

result.plot(unit="MJy/sr")
plt.show()

# %%
# A summary of the result has the number of sources with each flag:

result

# %%
# ``result.write("f770w.ecsv")`` writes the table, which ``BayesFitter`` and ``miricigale fit`` read;
# ``result.write("f770w.fits")`` keeps images and covariances too. The command does the same from files:
#
# .. code-block:: console
#
#    $ miricigale photometry --image f770w.fits --highres f160w.fits --filter F770W \
#          --psf psf_f770w.fits --highres-psf psf_f160w.fits -o f770w.ecsv
#
# See :doc:`/method/photometry` for the templates, :doc:`/method/photometry_files` for units, weights and masks
# of files, and :doc:`/accuracy/photometry` for tests of fluxes and errors.
