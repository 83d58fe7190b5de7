"""First attempts at the classes: what works, and what is refused in a sentence."""

import copy
import pickle
import re
import tomllib
from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from astropy.convolution import Gaussian2DKernel
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, NDData, StdDevUncertainty
from astropy.table import QTable, Table
from astropy.wcs import WCS
from photutils.psf import CircularGaussianPRF, MoffatPSF

import miricigale as m
from miricigale import photometry, psf

#: What the calls name besides the objects of the fixture.
MODULES = {
    "copy": copy, "pickle": pickle, "pd": pd, "np": np, "u": u, "m": m, "psf": psf,
    "photometry": photometry, "Table": Table, "QTable": QTable, "NDData": NDData, "MoffatPSF": MoffatPSF,
    "Gaussian2DKernel": Gaussian2DKernel,
}  # fmt: skip
#: Messages of Python about code, which say nothing of what is wanted.
BARE = re.compile(
    r"positional argument|unexpected keyword|NoneType|object is not|object has no attribute '\w+'$"
)

#: Intent, call and outcome: nothing where it works, else what the sentence of the refusal says.
GUESSES = tomllib.loads(Path(__file__).with_name("guesses.toml").read_text("utf-8"))["guesses"]


def grid(n, scale):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ["RA---TAN", "DEC--TAN"], [150.1, 2.2]
    wcs.wcs.crpix, wcs.wcs.cdelt = [(n + 1) / 2] * 2, [-scale / 3600, scale / 3600]
    return wcs


def point(n, scale, fwhm):
    """A source of 10 uJy in the middle of an image."""
    y, x = np.mgrid[:n, :n]
    data = CircularGaussianPRF(x_0=n / 2 - 0.5, y_0=n / 2 - 0.5, flux=10.0, fwhm=fwhm / scale)(x, y)
    data += np.random.default_rng(1).normal(0, 0.01, data.shape)
    error = StdDevUncertainty(np.full(data.shape, 0.01))
    return CCDData(data, unit="uJy", wcs=grid(n, scale), uncertainty=error)


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What the calls are about."""
    kind = {"fov": 3 * u.arcsec}
    sharp = psf.gaussian_psf(0.12 * u.arcsec, pixel_scale=0.03 * u.arcsec, **kind)
    wide = psf.gaussian_psf(0.27 * u.arcsec, pixel_scale=0.09 * u.arcsec, **kind)
    sky = SkyCoord([150.1], [2.2], unit="deg")
    exposure = m.Exposure("F770W", n_groups=10, pointing=sky[0], subarray="SUB64")
    catalog = QTable({"sky": sky, "F770W": [5.0] * u.uJy, "profile": ["point"]})
    scene = m.Scene(catalog, exposure, background="low")
    image = point(60, 0.09, 0.27)
    folder = tmp_path_factory.mktemp("guesses")
    ramp = m.Detector().expose(scene, seed=1)
    ramp.write(folder / "a_uncal.fits")
    wide.write(folder / "psf.fits")
    known = {
        "MODEL": m.SEDModel.yang2021(), "AXES": {"redshift": [0.5, 1.0]},
        "P": sky[0], "SKY": sky, "CATALOG": catalog, "SHARP": sharp, "WIDE": wide, "IMAGE": image,
        "HIGHRES": point(180, 0.03, 0.12), "exposure": exposure, "scene": scene, "ramp": ramp,
        "LABELS": (point(180, 0.03, 0.12).data > 0.05).astype(int), "PSF_FILE": folder / "psf.fits",
        "result": m.ForcedPhotometer(psf=wide).measure(image, sky), "tmp_path": folder,
    }  # fmt: skip
    return MODULES | known


@pytest.mark.filterwarnings("ignore:.*sources are points", "ignore:.*may be dark")
@pytest.mark.parametrize(
    ("call", "outcome"), [pytest.param(call, outcome, id=name) for name, call, *outcome in GUESSES]
)
def test_guess(call, outcome, names):
    try:
        if not outcome:
            eval(call, names)
            return
        with pytest.raises(Exception, match=outcome[0]) as refusal:
            eval(call, names)
        assert not BARE.search(str(refusal.value))
    finally:
        plt.close("all")
