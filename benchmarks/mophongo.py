"""
Fluxes of mophongo and of T-PHOT's method compared with the package's, on a real field.

`python benchmarks/mophongo.py DATA/uds`: PRIMER-UDS, F770W with F444W as the prior, the same 384 segments. DATA is
the folder of real files (README, "uds"); mophongo's fluxes are a file there, since neither it nor T-PHOT is
installed. T-PHOT's method is what Merlin et al. (2015) write: bare segments through one kernel, least squares, no
shape changes. Printed by signal-to-noise: number, median and robust scatter of their flux over ours (above 5),
and of the differences over our errors.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
from astropy.stats import mad_std
from astropy.table import Table

from miricigale.photometry import ErrorSettings, MosaicFile
from miricigale.photometry.commands.from_files import measure_files

BINS = ((-np.inf, 3), (3, 5), (5, 10), (10, 30), (30, np.inf))


def measured(uds, **options):
    """Table of F770W by the package."""
    start, psfs = f"{uds}/uds-test-", f"{uds}/psf/uds-test-f444w"
    image, prior = (
        MosaicFile(f"{start}{band}_sci.fits.gz", weight=f"{start}{band}_wht.fits.gz", **more)
        for band, more in (
            ("f770w", {"filter": "F770W"}),
            ("f444w", {"psf": f"{psfs}_psf.fits.gz[0,mean]"}),
        )
    )
    return measure_files(
        image, prior, segmentation=f"{start}LW_seg.fits.gz",
        kernel=f"{psfs}_kernel_f770w.fits.gz[0,mean]", **options,
    )  # fmt: skip


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("uds", type=Path, help="folder of the files")
    uds = parser.parse_args().uds
    # about the scale of the weights, and half a pixel of the replicated image
    warnings.simplefilter("ignore")
    ours = measured(uds)
    errors = ErrorSettings(size_scatter=None)
    bare = measured(uds, template="cutout", wings=False, errors=errors, second_pass=False)
    name = "miri.f770w"
    flux, error = (ours[one].to_value("uJy") for one in (name, f"{name}_err"))
    theirs = Table.read(uds / "photometry_ca3cf34.cat", format="ascii")
    assert list(theirs["id"]) == list(ours["id"])
    # in 10 nJy of replicated pixels, four times each
    others = {"mophongo": 0.0025 * np.asarray(theirs["flux_1"])}
    others["segments, as T-PHOT"] = bare[name].to_value("uJy")
    crowded = np.asarray(ours[f"{name}_crowded"])
    for label, other in others.items():
        print(f"{label}: median errors {np.nanmedian(error):.4f} (ours)", end="")
        if label == "mophongo":
            print(f", {np.nanmedian(0.0025 * np.asarray(theirs['err_1'])):.4f} (theirs)", end="")
        print()
        for low, high in BINS:
            rows = (flux / error >= low) & (flux / error < high) & np.isfinite(other)
            pulls, ratio = ((other - flux) / error)[rows], (other / flux)[rows]
            text = f"{np.median(ratio):.3f}  {mad_std(ratio):.3f}" if low >= 5 else "-  -"
            print(f"  {low:>4g} {high:>4g}  {rows.sum():3d}  {text}", end="")
            print(f"  {np.median(pulls):+.2f}  {mad_std(pulls):.2f}", end="")
            print(f"  isolated {np.count_nonzero(rows & ~crowded)}")


if __name__ == "__main__":
    main()
