"""
Find out what a product is
==========================

You have a file from a run, from a colleague, or from the archive. You want to know what it holds, and a picture
of it.
"""

# %%
# ``miricigale show FILE`` prints what it is, and draws it with ``--picture``. It knows images, ramps, PSFs,
# kernels, fits and tables of the package, JWST files, and any other FITS image or table. Here are some files to
# look at:

import astropy.units as u
import matplotlib.pyplot as plt

from miricigale import Detector, Exposure, MatchingKernel, Scene
from miricigale.cli import main
from miricigale.scene import example_field

field = example_field(["F160W", "F770W"], size=15 * u.arcsec)
field.images["miri.f770w"].write("f770w.fits", overwrite=True)
psf, sharp = field.psfs["miri.f770w"], field.psfs["wfc3.f160w"]
MatchingKernel.from_psfs(sharp, psf).write("kernel.fits", overwrite=True)

place = {"pointing": "53.13 -27.83", "subarray": "SUB256"}
exposure = Exposure("F770W", n_groups=20, **place)
star = {"ra": [53.13], "dec": [-27.83], "F770W": [50] * u.uJy, "profile": "point"}
ramp = Detector().expose(Scene(star, exposure, background="low"), seed=1)
path = ramp.write("f770w_uncal.fits", overwrite=True)

# %%
# .. code-block:: console
#
#    $ miricigale show kernel.fits --picture

status = main(["show", "kernel.fits", "--picture", "kernel.png"])

# %%
# .. code-block:: console
#
#    $ miricigale show f770w_uncal.fits --picture ramp.png

status = main(["show", "f770w_uncal.fits", "--picture", "ramp.png"])

# %%
# The pictures that were written:

figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
for ax, name in zip(axes, ["kernel.png", "ramp.png"], strict=True):
    ax.imshow(plt.imread(name))
    ax.set_axis_off()
plt.show()

# %%
# In a session, ``read`` of each class takes the file: ``MatchingKernel.read``, ``Ramp.read``,
# ``FitResults.read``; images are ``instrument.read_image``, tables ``QTable.read``. :doc:`/files` lists the
# products, :doc:`/glossary` their columns and flags.
