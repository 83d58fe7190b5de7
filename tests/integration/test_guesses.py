"""First attempts at the classes: what works, and what is refused in a sentence."""

import copy
import pickle
import re

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
    "photometry": photometry, "Table": Table, "NDData": NDData, "MoffatPSF": MoffatPSF,
    "Gaussian2DKernel": Gaussian2DKernel,
}  # fmt: skip
#: Messages of Python about code, which say nothing of what is wanted.
BARE = re.compile("positional argument|unexpected keyword|NoneType|object is not|object has no")

#: Intent, call and outcome: None where it works, else what the sentence of the refusal says.
GUESSES = [
    ("filter by its band", 'm.Filter("F770W")', None),
    ("filter of the SVO", 'm.Filter("JWST/MIRI.F770W")', None),
    ("filter of CIGALE", 'm.Filter("IRAC1")', None),
    ("filter with a typing error", 'm.Filter("F771W")', "the nearest of .*f770w"),
    ("throughput at a wavelength", 'm.Filter("F770W")(7.7 * u.um)', None),
    ("width by another name", 'm.Filter("F770W").width', None),
    ("a curve without unit", 'm.Filter("my", [1, 2, 3], [0, 1, 0])', "'wave' must be a quantity"),
    ("exposure of an hour", 'm.Exposure("F770W", time=1 * u.h, pointing=P)', None),
    ("exposure by groups", 'm.Exposure("F770W", n_groups=50)', None),
    ("pointing as text", 'm.Exposure("F770W", n_groups=50, pointing="10h00m24s +02d12m")', None),
    ("pointing as numbers", 'm.Exposure("F770W", n_groups=50, pointing=(150.1, 2.2))', None),
    ("pointing nowhere", 'm.Exposure("F770W", n_groups=50, pointing="here")', "'pointing' must be"),
    ("exposure in another camera", 'm.Exposure("F444W", n_groups=50)', "no imaging filter 'F444W'"),
    ("roll without unit", 'm.Exposure("F770W", n_groups=50, pointing=P, roll=3)', "'roll' must be"),
    ("lower case", 'm.Exposure("f770w", n_groups=9, readout="fastr1", subarray="sub64")', None),
    ("four dithers", "exposure.dithered(4)", None),
    ("footprint", "exposure.footprint", None),
    ("exposure on the sky", "exposure.plot()", None),
    ("a name that is not there", "exposure.filtr", "Exposure has no 'filtr'; it has filter"),
    ("scene of points", "m.Scene({'sky': SKY, 'F770W': [5.0] * u.uJy}, exposure)", None),
    (
        "columns in capitals",
        "m.Scene(Table({'RA': [150.1], 'DEC': [2.2], 'mag': [22.0]}), exposure)",
        None,
    ),
    (
        "scene of pandas",
        "m.Scene(pd.DataFrame({'ra': [150.1], 'dec': [2.2], 'mag': [22.0]}), exposure)",
        None,
    ),
    ("fluxes without unit", "m.Scene({'sky': SKY, 'F770W': [5]}, exposure)", "convertible to uJy"),
    ("no positions", "m.Scene({'F770W': [5.0] * u.uJy}, exposure)", "a table with positions"),
    ("PSF of photutils", "m.Scene(CATALOG, exposure, psf=MoffatPSF(alpha=2)).render()", None),
    ("PSF as astropy kernel", "m.Scene(CATALOG, exposure, psf=Gaussian2DKernel(1)).render()", None),
    ("PSF that is none", "m.Scene(CATALOG, exposure, psf='sharp')", "'psf' must be a PSF or model"),
    ("low background", 'm.Scene(CATALOG, exposure, background="low")', None),
    ("background without unit", "m.Scene(CATALOG, exposure, background=5)", "a Quantity in MJy/sr"),
    ("image of a scene", 'scene.write(tmp_path / "s.fits")', None),
    ("picture of a scene", "scene.plot()", None),
    ("expose a scene", "m.Detector().expose(scene, seed=1)", None),
    ("expose an array", "m.Detector().expose(np.ones((64, 64)), exposure)", "'image' must be"),
    ("gain of a detector", "m.Detector().gain", None),
    ("ramp of a pixel", "ramp.plot((30, 30))", None),
    ("first integration", "ramp[0]", None),
    ("reduce a ramp", "m.Reducer().run(ramp)", None),
    ("reduce files", 'm.Reducer().run(str(tmp_path / "*_uncal.fits"))', None),
    ("reduce what is not there", 'm.Reducer().run("absent_uncal.fits")', "no such file"),
    ("method of the background", 'm.Reducer(background="sep")', None),
    ("no background", "m.Reducer(background=None)", "'background' must be a BackgroundSettings"),
    ("slopes of a file", 'm.Reducer().fit_ramp(tmp_path / "a_uncal.fits")', None),
    (
        "mosaic without a grid",
        "m.Reducer().mosaic(m.Reducer().calibrate(m.Reducer().fit_ramp(ramp)))",
        None,
    ),
    ("kernel of two PSFs", "m.MatchingKernel.from_psfs(SHARP, WIDE)", None),
    ("kernel by its class", "m.MatchingKernel(SHARP, WIDE)", "'MatchingKernel.from_psfs' makes"),
    ("energies of a kernel", "m.MatchingKernel.from_psfs(SHARP, WIDE).plot()", None),
    ("convolve an image", "m.MatchingKernel.from_psfs(SHARP, WIDE)(HIGHRES)", None),
    ("photometer of PSFs", "m.ForcedPhotometer(psf=WIDE, highres_psf=SHARP)", None),
    ("photometer of nothing", "m.ForcedPhotometer()", "'kernel, psf' must be one of them given"),
    ("photometry of points", "m.ForcedPhotometer(psf=WIDE).measure(IMAGE, SKY)", None),
    ("a prior", "m.ForcedPhotometer(psf=WIDE, highres_psf=SHARP).measure(IMAGE, HIGHRES)", None),
    ("an array", "m.ForcedPhotometer(psf=WIDE).measure(np.ones((9, 9)), SKY)", "'image' must be"),
    (
        "segments as an array",
        "m.ForcedPhotometer(psf=WIDE, highres_psf=SHARP).measure(IMAGE, HIGHRES, HIGHRES.data > 0.05)",
        "'segmentation' must be whole numbers",
    ),
    (
        "labels as an array",
        "m.ForcedPhotometer(psf=WIDE, highres_psf=SHARP).measure(IMAGE, HIGHRES, LABELS)",
        None,
    ),
    (
        "sources by pixels",
        "m.ForcedPhotometer(psf=WIDE).measure(IMAGE, catalog={'x': [29.5], 'y': [29.5]})",
        None,
    ),
    ("PSFs of files", "m.MatchingKernel.from_psfs(PSF_FILE, PSF_FILE)", None),
    ("results as VOTable", 'result.write(tmp_path / "r.vot")', None),
    (
        "noise of bands by name",
        'm.ErrorModel.from_depths({"F770W": 26 * u.ABmag}).perturb({"F770W": [1.0] * u.uJy}, seed=1)',
        None,
    ),
    ("exposure for a time", 'm.Exposure("F770W", 1 * u.hour).total_time', None),
    ("detector as a function", "m.Detector()(scene, seed=1)", None),
    ("group of a ramp", "ramp[0, 5]", "'number' must be that of an integration"),
    ("image as NDData", "m.ForcedPhotometer(psf=WIDE).measure(NDData(IMAGE), SKY)", None),
    ("fluxes", "result['flux']", None),
    ("a row", "result[0]", None),
    ("some rows", "result[result.snr > 0]", None),
    ("a source by id", "result.loc[1]", None),
    ("a column that is not there", "result['fluxx']", "no column 'fluxx'.*did you mean 'flux'"),
    ("table to pandas", "result.to_pandas()", None),
    ("magnitudes", "result.magnitude", None),
    ("flags in words", "result.flag_names()", None),
    ("results in short", "result.summary()", None),
    ("results as CSV", 'result.write(tmp_path / "r.csv")', None),
    ("detection", "photometry.detect_sources(HIGHRES)", None),
    ("errors of an exposure", "m.ErrorModel.from_exposure(exposure)", None),
    ("a limit", 'm.ErrorModel.from_depths({"F770W": 26 * u.ABmag}).limiting_flux("F770W")', None),
    ("errors over flux", "m.ErrorModel.from_exposure(exposure).plot()", None),
    ("PSF by the band", 'psf.miri_psf("F770W")', None),
    ("PSF of a wrong band", 'psf.miri_psf("F444W")', "no PSF for the filter 'F444W'"),
    ("model spectrum", "m.SEDModel.yang2021().evaluate(redshift=1.0, tau=1 * u.Gyr)", None),
    ("fluxes of models", "m.SEDModel.yang2021().fluxes({'redshift': [1.0]}, ['F770W'])", None),
    ("unknown parameter", "m.SEDModel.yang2021().evaluate(redshft=1)", "did you mean 'redshift'"),
    ("star formation of a model", "m.SEDModel.yang2021().evaluate(redshift=1.0).sfr", None),
    ("component of a model", 'm.SEDModel.yang2021()["agn"]', None),
    ("component that is none", 'm.SEDModel.yang2021()["dst"]', "no component 'dst'; known: bc03"),
    ("range of a filter", 'm.Filter("F770W").min_wavelength', None),
    ("a copy of an exposure", "copy.deepcopy(exposure)", None),
    ("pickle of a reducer", "pickle.loads(pickle.dumps(m.Reducer()))", None),
    (
        "filter of a file",
        'm.Filter.from_file("f.dat")',
        "Filter has no 'from_file'; it has from_name",
    ),
    ("filter as a table file", 'm.Filter("F770W").write(tmp_path / "f.vot")', None),
    (
        "fluxes by keywords",
        "MODEL.fluxes(redshift=1, filters=['F770W'])",
        r"takes \(table, filters\)",
    ),
    (
        "bands before axes",
        "MODEL.grid(['F770W'], axes={'redshift': [1.0]})",
        r"takes \(axes, filters",
    ),
    (
        "exposure time by its keyword",
        'm.Exposure("F770W", exptime=1)',
        r"takes \(filter, time=None",
    ),
    ("gain of a detector to be", "m.Detector(gain=3)", r"Detector takes \(effects=None"),
    ("fitter of bands", "m.BayesFitter(MODEL, ['F770W', 'IRAC1'], axes=AXES)", None),
    (
        "fitter without axes",
        "m.BayesFitter(MODEL, ['F770W'])",
        "'filters' and 'axes' must be given",
    ),
]


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
    ("call", "outcome"), [pytest.param(*one[1:], id=one[0]) for one in GUESSES]
)
def test_guess(call, outcome, names):
    try:
        if outcome is None:
            eval(call, names)
            return
        with pytest.raises(Exception, match=outcome) as refusal:
            eval(call, names)
        assert not BARE.search(str(refusal.value))
    finally:
        plt.close("all")
