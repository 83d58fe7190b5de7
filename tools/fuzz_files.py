"""
Mutated files of every kind that users give: each is read, or refused in one sentence that names the file.

    python tools/fuzz_files.py [--n 2000] [--kinds ecsv image ...] [--seed 1] [--keep FOLDER]

Files of each kind are made by the package, changed at random (bytes, cut and repeated pieces, large numbers,
names, brackets) and read by what a command reads them with, in processes that may take 10 s and 1.5 GB for a
file. Counted are files that were read, those refused, and what is wrong: another exception than those that a
command says in a sentence, no name of the file in it, too much time or memory.
"""

import argparse
import contextlib
import gzip
import importlib.util
import json
import logging
import multiprocessing
import re
import resource
import shutil
import signal
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable

SECONDS, GIGABYTES = 10, 1.5
#: What a command says in one sentence (miricigale.cli.program).
SAID = (ValueError, KeyError, OSError, ImportError, u.UnitsError)
STUDY = """
[run]
name = "own"
[catalog]
source = "goodss"
mag_limit = 25.5
[sed]
frac_agn = [0.0, 0.4, "field"]
[exposures]
filters = ["miri.f770w", "miri.f1500w"]
n_groups = [40, 40]
n_dithers = [4, 4]
[fit]
sets = ["all", "none"]
"""
PLAN = """
[exposures]
bands = ["miri.f770w", "miri.f1500w"]
time = [1200.0, 1665.0]
dithers = 4
sets = ["all", "f770w"]
[noise]
excess = 1.4
"""


def catalog():
    """A small catalog with errors, units, a mask and meta."""
    rng, n = np.random.default_rng(1), 30
    table = QTable({"id": np.arange(1, n + 1), "redshift": rng.uniform(0.2, 3, n)})
    table["sky"] = SkyCoord(
        53 + rng.uniform(0, 0.02, n), -27.8 + rng.uniform(0, 0.02, n), unit="deg"
    )
    for name in ("wfc3.f160w", "irac.ch1", "miri.f770w"):
        table[name] = rng.uniform(0.1, 20, n) * u.uJy
        table[f"{name}_err"] = 0.1 * table[name]
    table["mag_f160w"] = table["wfc3.f160w"].to(u.ABmag)
    table.meta["comment"] = "a catalog"
    return table


def image_hdus(shape=(64, 64)):
    """An image as the pipeline has it."""
    from miricigale.instrument import north_up_wcs

    rng = np.random.default_rng(2)
    wcs = north_up_wcs(SkyCoord(53.0, -27.8, unit="deg"), 0.06 * u.arcsec, shape)
    header = wcs.to_header()
    header["BUNIT"] = "MJy/sr"
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(rng.normal(size=shape).astype("f4"), header, "SCI")]
    return fits.HDUList([*hdus, fits.ImageHDU(np.ones(shape, "f4"), header, "ERR")])


def make_files(folder):
    """One file of each kind: name to path, and how it is read."""
    from miricigale import ErrorModel, Filter, FitResults, SEDModel
    from miricigale.cigale import read_pcigale_ini
    from miricigale.filters import CatalogMap, read_catalog_photometry
    from miricigale.fitting import BayesFitter
    from miricigale.instrument import read_dithers
    from miricigale.photometry.commands.kernel_files import read_kernel
    from miricigale.photometry.detection.prior_catalog import read_prior
    from miricigale.photometry.images.mosaics import read_mosaic
    from miricigale.planning import load_plan
    from miricigale.psf import filter_psf
    from miricigale.psf.files import read_psf
    from miricigale.reduction.images.files import read_images
    from miricigale.scene import read_catalog
    from miricigale.sed import SED
    from miricigale.utils.table_files import write_table
    from miricigale.workflow import ProductStore, load_config

    table, kinds = catalog(), {}

    def add(kind, name, read):
        kinds[kind] = (folder / name, read)
        return folder / name

    plain = table.copy()
    plain["ra"], plain["dec"] = table["sky"].ra, table["sky"].dec
    plain.remove_column("sky")
    for kind, name in (("ecsv", "c.ecsv"), ("fits table", "c.fits"), ("votable", "c.xml")):
        write_table(table, add(kind, name, read_catalog))
    if importlib.util.find_spec("pyarrow"):
        write_table(plain, add("parquet", "c.parquet", read_catalog))
    units = {"units": {"flux": "uJy"}}
    write_table(plain, add("csv", "c.csv", lambda path: read_catalog_photometry(path, **units)))
    for kind, name, text, read in (
        ("study", "s.toml", STUDY, load_config),
        ("plan", "p.toml", PLAN, load_plan),
        ("dithers", "d.ecsv", DITHERS, read_dithers),
        ("apt pointings", "plan.pointing", POINTINGS, read_dithers),
        ("column map", "map.toml", COLUMNS, CatalogMap.read),
        ("eazy map", "own.translate", TRANSLATE, CatalogMap.read),
        (
            "filter",
            "f.dat",
            "".join(f"{w} {t}\n" for w, t in zip(range(1, 41), range(40), strict=True)),
            lambda path: Filter.read(path, unit="um"),
        ),
        ("pcigale.ini", "pcigale.ini", INI, read_pcigale_ini),
    ):
        add(kind, name, read).write_text(text, encoding="utf-8")
    run = {"config": {"run": {"name": "own"}}, "stages": {"catalog": RECORD, "truth/agn00": RECORD}}
    run_folder = add("manifest", "run/manifest.json", lambda path: ProductStore(path.parent).config)
    run_folder.parent.mkdir()
    run_folder.write_text(json.dumps(run))
    model = SEDModel.yang2021(libraries="bundled")
    model.evaluate(age=2.0, redshift=1.0).write(add("spectrum", "sed.ecsv", SED.read))
    ErrorModel.yang2021().write(add("errors", "errors.ecsv", ErrorModel.read))
    axes = {"age": [1.0, 3.0], "redshift": [0.5, 1.0, 2.0]}
    bands = ["wfc3.f160w", "irac.ch1", "miri.f770w"]
    fitter = BayesFitter(SEDModel.yang2021(agn=False, libraries="bundled"), bands, axes=axes)
    fitter.fit(table).write(add("results", "r.fits", FitResults.read))
    image_hdus().writeto(add("image", "i.fits", read_mosaic))
    segments = image_hdus()["SCI"].copy()
    segments.data = np.kron(np.arange(1, 17).reshape(4, 4), np.ones((16, 16))).astype(np.int32)
    prior = read_mosaic(folder / "i.fits")
    fits.HDUList([fits.PrimaryHDU(), segments]).writeto(
        add("segmentation", "seg.fits", lambda path: read_prior(prior, segmentation=path))
    )
    packed = add("gzip image", "i.fits.gz", read_mosaic)
    packed.write_bytes(gzip.compress((folder / "i.fits").read_bytes(), mtime=0))
    with zipfile.ZipFile(add("zip table", "c.ecsv.zip", read_catalog), "w") as archive:
        archive.write(folder / "c.ecsv", "c.ecsv")
    filter_psf("miri.f770w", pixel_scale=0.11 * u.arcsec, pa=0 * u.deg).write(
        add("psf", "psf.fits", read_psf)
    )
    fits.HDUList([fits.PrimaryHDU(np.eye(15) / 15)]).writeto(
        add("kernel", "k.fits", lambda path: read_kernel(path, pixel_scale=0.06 * u.arcsec))
    )
    exposure = image_hdus()
    exposure[0].header.update(INSTRUME="MIRI", DETECTOR="MIRIMAGE", FILTER="F770W")
    exposure.writeto(add("exposure", "jw_cal.fits", read_images))
    return kinds


INI = """
data_file = c.txt
parameters_file =
sed_modules = sfhdelayed, bc03, nebular, dustatt_modified_starburst, dale2014, redshifting
analysis_method = pdf_analysis
cores = 1
bands = wfc3.f160w, irac.ch1
[sed_modules_params]
  [[sfhdelayed]]
    tau_main = 1000, 3000
    age_main = 1000, 4000
  [[redshifting]]
    redshift = 1.0
"""

PRODUCT = {"sha256": "0" * 64, "bytes": 3}
RECORD = {"hash": "0" * 64, "seconds": 1.0, "products": {"catalog.ecsv": PRODUCT}}
DITHERS = """# %ECSV 1.0
# ---
# datatype:
# - {name: x_offset, unit: arcsec, datatype: float64}
# - {name: y_offset, unit: arcsec, datatype: float64}
x_offset y_offset
0.0 0.0
1.1 -2.0
-3.5 4.25
"""

#: APT's list of pointings of one observation, a column map and a translation of EAZY.
POINTINGS = """# APT Output Product
========================================
* Deep field (Obs 1)
** Visit 1:1
Tar Tile Exp Dith Aperture Name Target RA Dec BaseX BaseY DithX DithY V2 V3 IdlX IdlY Level Type ExPar DkPar dDist
1 1 1 1 MIRIM_FULL 1 FIELD +80.4 -69.4 +0.0 +0.0 +0.0 +0.0 -453.5 -373.8 +0.0 +0.0 TARGET SCIENCE 0 0 0.0
1 1 1 2 MIRIM_FULL 1 FIELD +80.4 -69.4 +0.0 +0.0 +1.1 -2.0 -453.5 -373.8 +1.1 -2.0 DITHER SCIENCE 0 0 2.2
"""
COLUMNS = """
[columns]
id = "NUMBER"
"wfc3.f160w" = "f_F160W"
"wfc3.f160w_err" = "e_F160W"
"miri.f770w" = "f_F770W"
"miri.f770w_err" = "e_F770W"
[units]
flux = "uJy"
"""
TRANSLATE = """id id
f_F160W F205
e_F160W E205
f_F606W F236
e_F606W E236 1.2
"""

_BIG = (
    b"1000000000",
    b"-1",
    b"1e309",
    b"nan",
    b"99999999999999999999",
    b"0",
    b"'",
    b"[[[[",
    b"null",
)


def mutate(data, rng):
    """Some of the bytes of a file changed."""
    # text remains text
    text = (32, 127) if b"\0" not in data else (0, 256)
    data = bytearray(data)
    for _ in range(rng.integers(1, 3)):
        n = max(len(data), 1)
        # headers are at the beginning
        at = int(rng.integers(n) if rng.random() < 0.5 else rng.integers(min(n, 4000)))
        span = int(rng.integers(1, 200))
        what = rng.integers(8)
        if what == 0:
            for i in rng.integers(n, size=rng.integers(1, 5)):
                data[i % n : i % n + 1] = bytes([rng.integers(*text)])
        elif what == 1:
            del data[at : at + span]
        elif what == 2:
            data[at:at] = data[at : at + span] * int(rng.integers(1, 50))
        elif what == 3:
            del data[at:]
        elif what == 4:
            numbers = [m.span() for m in re.finditer(rb"\d+", data[at : at + 4000])]
            if numbers:
                a, b = numbers[rng.integers(len(numbers))]
                data[at + a : at + b] = _BIG[rng.integers(len(_BIG))]
        elif what == 5:
            words = [m.span() for m in re.finditer(rb"[A-Za-z_]{3,}", data[at : at + 4000])]
            if words:
                a, b = words[rng.integers(len(words))]
                data[at + a : at + b] = data[at + a : at + b][::-1]
        elif what == 6:
            data[at:at] = bytes(rng.integers(*text, size=span % 20, dtype=np.uint8))
        else:
            lines = bytes(data).split(b"\n")
            i, j = rng.integers(len(lines), size=2)
            lines[i], lines[j] = lines[j], lines[i]
            data = bytearray(b"\n".join(lines))
    return bytes(data)


def _late(*_):
    raise TimeoutError


def try_file(path, read):
    """What is wrong with how a file is read or refused: a sentence; 'read' or 'refused' if nothing is."""
    before, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    signal.signal(signal.SIGALRM, _late)
    signal.alarm(SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read(path)
        got = "read"
    except TimeoutError:
        got = f"over {SECONDS} s"
    except SAID as err:
        texts = [str(err), *getattr(err, "__notes__", ())]
        # of a manifest the folder is what the user knows
        named = any(name in text for text in texts for name in (path.name, f"in {path.parent}"))
        got = "refused" if named else f"no name: {_where(err)}"
    except Exception as err:  # that is what is looked for
        got = _where(err)
    finally:
        signal.alarm(0)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e6
    if grown > GIGABYTES or time.monotonic() - begin > SECONDS:
        got = f"{grown:.1f} GB, {time.monotonic() - begin:.0f} s ({got})"
    return got


def _where(err):
    frames = [f for f in traceback.extract_tb(err.__traceback__) if "miricigale" in f.filename]
    last = frames[-1]
    return f"{type(err).__name__} at {Path(last.filename).name}:{last.lineno}: {str(err)[:80]!r}"


def fuzz(kind, n, seed, keep, results):
    """Try ``n`` files of a kind; what came is sent one by one."""
    logging.disable()
    resource.setrlimit(resource.RLIMIT_AS, (12 << 30,) * 2)
    with tempfile.TemporaryDirectory() as place:
        path, read = make_files(Path(place))[kind]
        data = path.read_bytes()
        results.send((-1, try_file(path, read)))
        for i in range(n):
            path.write_bytes(mutate(data, np.random.default_rng([seed, i])))
            got = try_file(path, read)
            if keep and got not in ("read", "refused"):
                shutil.copy(path, keep / f"{kind.replace(' ', '_')}_{i}_{path.name}")
            results.send((i, got))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--n", type=int, default=2000)
    parser.add_argument("--kinds", nargs="+")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--keep", type=Path, help="folder for the files with which something is wrong"
    )
    args = parser.parse_args()
    if args.keep:
        args.keep.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        kinds = args.kinds or list(make_files(Path(place)))
    bad = 0
    for kind in kinds:
        mine, theirs = multiprocessing.Pipe(duplex=False)
        process = multiprocessing.Process(
            target=fuzz, args=(kind, args.n, args.seed, args.keep, theirs)
        )
        process.start()
        theirs.close()
        got = []
        with contextlib.suppress(EOFError):
            while True:
                got.append(mine.recv())
        process.join()
        counts = Counter(re.sub(r"0x\w+", "", what) for i, what in got if i >= 0)
        if len(got) <= args.n:
            counts[f"the process ended after file {got[-1][0] if got else 'none'}"] += 1
        print(
            f"{kind}: unchanged {got[0][1] if got else 'none'}; {counts['read']} read, {counts['refused']} refused"
        )
        for what, many in counts.most_common():
            if what not in ("read", "refused"):
                bad += many
                print(f"    {many} {what}")
    raise SystemExit(bad > 0)


if __name__ == "__main__":
    main()
