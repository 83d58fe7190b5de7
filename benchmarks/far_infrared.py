"""
Infrared luminosities of galaxies with far-infrared photometry, against those that Stardust published.

    python benchmarks/far_infrared.py FOLDER                 the grids survey and far-infrared
    python benchmarks/far_infrared.py FOLDER --axes survey --model-error 0.1

FOLDER has cosmos_photometry_100.fits (COSMOS2015 and super-deblended far-infrared fluxes, in mJy) and
stardust_results_100.fits, as distributed with Stardust (Kokorev et al. 2021, ApJ 921, 40). Redshifts are those of
the file; errors of models are those of ``miricigale fit --axes``. Stardust's luminosity is that of 8-1000 um, all
components; ours is 3-1000 um, brought to 8-1000 um by the ratio of the best model.

For each grid: models, median of ours over Stardust's in dex with 16-84 %, its scatter (1.48 times the median
absolute deviation), and reduced chi2 (median, 84 %, 97.5 %, number above 10), CPU time for an object.
"""

import argparse
import time
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.stats import mad_std
from astropy.table import QTable, Table

from miricigale import BayesFitter, SEDModel
from miricigale.fitting import SurveyCalibration
from miricigale.utils.exceptions import MiricigaleWarning

OPTICAL = {
    "u": "sedpy.cfht_megacam_us_9301",
    "B": "sedpy.subaru_suprimecam_B",
    "V": "sedpy.subaru_suprimecam_V",
    "r": "sedpy.subaru_suprimecam_rp",
    "ip": "sedpy.subaru_suprimecam_ip",
    "Y": "sedpy.vista_vircam_Y",
    "J": "sedpy.vista_vircam_J",
    "H": "sedpy.vista_vircam_H",
    "Ks": "sedpy.vista_vircam_Ks",
}
INFRARED = {
    **{f"CH{i}": f"irac.ch{i}" for i in (1, 2, 3, 4)},
    "24": "mips.24",
    "100": "sedpy.herschel_pacs_100",
    "160": "sedpy.herschel_pacs_160",
    **{f"{wave}": f"sedpy.herschel_spire_{wave}" for wave in (250, 350, 500)},
}
#: Least error of each flux, as a part of it: zero points.
FLOOR = 0.02


def read(folder):
    """Photometry with bands of ours, redshifts included, and Stardust's luminosities in Lsun."""
    raw = Table.read(folder / "cosmos_photometry_100.fits")
    theirs = Table.read(folder / "stardust_results_100.fits")
    row = {key: i for i, key in enumerate(theirs["ID"])}
    table = QTable({"id": np.array(raw["id"]), "z": np.array(raw["z_spec"], float)})
    columns = {band: (f"{n}_FLUX_TOT_MW", f"{n}_FLUXERR_TOT_MW") for n, band in OPTICAL.items()}
    columns |= {band: (f"F{n}", f"DF{n}") for n, band in INFRARED.items()}
    for band, names in columns.items():
        flux, error = (np.array(raw[name], float) for name in names)
        good = np.isfinite(flux) & (flux > -90) & (error > 0) & (error < 1e5)
        error = np.hypot(error, FLOOR * flux)
        table[band] = np.where(good, flux, np.nan) * u.mJy
        table[f"{band}_err"] = np.where(good, error, np.nan) * u.mJy
    luminosity = np.array([theirs["LIR_total"][row[key]] for key in raw["id"]], float)
    return table, [*columns], luminosity


def share_beyond_8um(model, results):
    """8-1000 um light of the best models over that of 3-1000 um."""
    out = np.full(len(results), np.nan)
    for i in np.flatnonzero(results.fitted & (results.best["mass"] > 0)):
        known = {n: results.best[n][i] for n in model.parameters if n in results.best}
        sed = model.evaluate(**{n: value for n, value in known.items() if np.isfinite(value)})
        wave = sed.wave.to_value(u.um) / (1.0 + sed.redshift)
        light = sed.fnu.value / wave**2
        total, far = (
            np.trapezoid(np.where((wave >= low) & (wave <= 1000.0), light, 0.0), wave)
            for low in (3.0, 8.0)
        )
        out[i] = far / total
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--axes", nargs="+", default=["survey", "far-infrared"])
    parser.add_argument("--model-error", type=float, help="in place of that of each grid")
    args = parser.parse_args()
    warnings.simplefilter("ignore", MiricigaleWarning)
    photometry, bands, theirs = read(args.folder)
    for kind in args.axes:
        model = SEDModel.survey()
        axes = SEDModel.survey_axes(kind)
        error, part = (
            (SurveyCalibration.survey().template_error, 0.0) if kind == "survey" else (None, 0.1)
        )
        if args.model_error is not None:
            error, part = None, args.model_error
        fitter = BayesFitter(model, bands, axes=axes, template_error=error, model_error=part)
        start = time.process_time()
        results = fitter.fit(photometry, redshift="z")
        seconds = (time.process_time() - start) / len(photometry)
        ours = results.percentile("ir_luminosity", [0.5])[:, 0].to_value(u.Lsun)
        ratio = np.log10(ours * share_beyond_8um(model, results) / theirs)
        wide = np.where(np.isfinite(ratio), np.log10(ours / theirs), np.nan)
        chi2 = results.reduced_chi2[np.isfinite(ratio)]
        for name, some in (("8-1000 um", ratio), ("3-1000 um", wide)):
            low, mid, high = np.nanpercentile(some, [16, 50, 84])
            print(
                f"{kind:12s} {name}: {mid:+.3f} ({low:+.3f}, {high:+.3f}) dex, scatter "
                f"{mad_std(some[np.isfinite(some)]):.3f}"
            )
        text = " ".join(f"{value:.2f}" for value in np.nanpercentile(chi2, [50, 84, 97.5]))
        text += f" ({np.sum(chi2 > 10)} above 10)"
        print(
            f"{kind:12s} {fitter.grid.n_models:,} models, {chi2.size} objects; chi2 "
            f"{text}; {seconds:.3f} s an object"
        )


if __name__ == "__main__":
    main()
