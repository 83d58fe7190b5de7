"""Smoke test of an installed package: from a filter to a fit, on small data (`python smoke.py`)."""

import subprocess
import sys
from pathlib import Path

import astropy.units as u
import numpy as np

import miricigale
from miricigale import (
    BayesFitter,
    Detector,
    Exposure,
    FilterSet,
    ForcedPhotometer,
    Reducer,
    Scene,
    SEDModel,
)
from miricigale.psf import filter_psf
from miricigale.refdata import check_resources

SOURCES = {"ra": [53.130, 53.132], "dec": [-27.830, -27.832], "profile": "point"}
BANDS = ["wfc3.f160w", "irac.ch1", "miri.f770w"]


def main():
    """Run it; what is wrong raises."""
    tool = Path(sys.executable).with_name("miricigale")
    stated = subprocess.run([tool, "--version"], check=True, capture_output=True, text=True).stdout
    assert stated.strip() == miricigale.__version__
    states = {one.name: one.state for one in check_resources()}
    assert set(states.values()) <= {"ok", "absent", "from package"}, states

    model = SEDModel.yang2021(libraries="bundled")
    sed = model.evaluate(redshift=1.0, mass=3e10, age=3.0, ebv=0.3)
    fluxes = FilterSet(BANDS).synthetic_fluxes(sed)
    photometry = {"id": [1]}
    for name, flux in zip(BANDS, fluxes, strict=True):
        photometry |= {name: [flux.value] * u.uJy, f"{name}_err": [0.05 * flux.value] * u.uJy}
    axes = SEDModel.yang2021_axes("quick") | {"redshift": [0.5, 1.0, 1.5]}
    results = BayesFitter(model, BANDS, axes=axes).fit(photometry)
    assert results.fitted.all()

    exposure = Exposure("F770W", n_groups=20, pointing="53.131 -27.831", subarray="SUB256")
    scene = Scene(SOURCES | {"F770W": [200, 100] * u.uJy}, exposure, background="low")
    mosaic = Reducer().run([Detector().expose(scene, seed=1)]).mosaic
    psf = filter_psf("F770W", pixel_scale=0.11 * u.arcsec, pa=exposure.pa_aper)
    measured = ForcedPhotometer(psf=psf).measure(mosaic, catalog=SOURCES)
    assert np.allclose(measured.flux.value, [200, 100], rtol=0.1), measured.flux
    print(f"miricigale {miricigale.__version__} works on Python {sys.version.split()[0]}")


if __name__ == "__main__":
    main()
