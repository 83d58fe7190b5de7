"""Products of a run: written whole or not at all, checked when they are used again."""

import json
import os
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.wcs import WCS

from miricigale.refdata.locate import file_sha256
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import open_fits

__all__ = ["ProductStore", "read_image", "write_image"]

MANIFEST = "manifest.json"


def _plain(value):
    """A value as JSON knows it."""
    if isinstance(value, u.Quantity):
        return f"{value}"
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    return str(value)


def write_image(image, path, *, planes=None):
    """
    Write an image as FITS: SCI, ERR, MASK and further planes.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        Its WCS (with distortion) goes to the SCI header, its meta as JSON to the keyword
        META, so that names and types survive.
    path : path-like
        Where to; an existing file is replaced.
    planes : dict of str to `~numpy.ndarray`, optional
        Further image extensions by name.
    """
    header = image.wcs.to_header(relax=True) if image.wcs is not None else fits.Header()
    header["BUNIT"] = image.unit.to_string("fits")
    meta = {key: value for key, value in image.meta.items() if key != "created"}
    header["META"] = json.dumps(meta, default=_plain, allow_nan=True)
    hdus = [
        fits.PrimaryHDU(),
        fits.ImageHDU(np.asarray(image.data, np.float32), header, name="SCI"),
    ]
    if image.uncertainty is not None:
        hdus.append(fits.ImageHDU(np.asarray(image.uncertainty.array, np.float32), name="ERR"))
    if image.mask is not None:
        hdus.append(fits.ImageHDU(np.asarray(image.mask, np.uint8), name="MASK"))
    for name, plane in (planes or {}).items():
        hdus.append(fits.ImageHDU(np.asarray(plane), name=name.upper()))
    fits.HDUList(hdus).writeto(path, overwrite=True, checksum=True)


def read_image(path, *, planes=()):
    """
    Read what `write_image` wrote.

    Parameters
    ----------
    path : path-like
        The file.
    planes : iterable of str, optional
        Names of further planes wanted.

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        Or a tuple of it and the planes, if some were asked for.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or has no SCI extension.
    """
    hdus = open_fits(path, wanted="an image (FITS with SCI)")
    with hdus:
        if "SCI" not in hdus:
            msg = f"{path} has no SCI extension, only {[hdu.name for hdu in hdus]}"
            raise DataError(msg)
        header = hdus["SCI"].header
        wcs = WCS(header)
        image = CCDData(
            np.array(hdus["SCI"].data, np.float32),
            unit=u.Unit(header["BUNIT"]),
            wcs=wcs if wcs.has_celestial else None,
            uncertainty=StdDevUncertainty(np.array(hdus["ERR"].data, np.float32))
            if "ERR" in hdus
            else None,
            mask=np.array(hdus["MASK"].data, bool) if "MASK" in hdus else None,
            meta=json.loads(header.get("META", "{}")),
        )
        extra = [np.array(hdus[name.upper()].data) for name in planes]
    return (image, *extra) if extra else image


class ProductStore:
    """
    The folder of a run and the manifest of what stands in it.

    Parameters
    ----------
    folder : path-like
        Made if it does not exist.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the folder holds files but no manifest (it is not a run's folder), or the
        manifest cannot be read.
    """

    def __init__(self, folder):
        self.folder = Path(folder)
        path = self.folder / MANIFEST
        self.records = {}
        if path.is_file():
            self.records = _read_manifest(path)
        elif self.folder.exists():
            # a run that was killed at its first moment leaves these
            known = ("run.lock", ".partial-")
            if not self.folder.is_dir() or any(
                not entry.name.startswith(known) for entry in self.folder.iterdir()
            ):
                msg = (
                    f"{self.folder} exists, is not empty and is no run's folder; choose another "
                    "with --output"
                )
                raise DataError(msg)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = self.folder / "run.lock"

    def __enter__(self):
        try:
            handle = os.open(self._lock, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        except FileExistsError:
            owner = self._lock.read_text().strip()
            if owner.isdigit() and _alive(int(owner)):
                msg = f"{self.folder} is in use by process {owner}"
                raise DataError(msg) from None
            # left over by a run that was killed
            handle = os.open(self._lock, os.O_TRUNC | os.O_WRONLY)
        with os.fdopen(handle, "w") as lock:
            lock.write(str(os.getpid()))
        self._write_manifest()
        return self

    def __exit__(self, *exc):
        self._lock.unlink(missing_ok=True)

    def path(self, name):
        """Path of a product by its name in the folder."""
        return self.folder / name

    def save(self, name, writer):
        """
        Write a product under a temporary name, then rename it.

        Parameters
        ----------
        name : str
            Name in the folder; sub-folders are made.
        writer : callable
            Called with the temporary path, whose suffix is that of ``name``.

        Returns
        -------
        path : `pathlib.Path`
        """
        path = self.path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".partial-{path.name}")
        writer(partial)
        os.replace(partial, path)
        return path

    def is_current(self, key, digest):
        """
        Whether a stage's products stand as its record says.

        Parameters
        ----------
        key : str
            Stage, or stage and unit.
        digest : str
            Hash of everything that the products depend on.
        """
        record = self.records.get(key)
        if record is None or record["hash"] != digest:
            return False
        return all(
            self.path(name).is_file()
            and self.path(name).stat().st_size == product["bytes"]
            and file_sha256(self.path(name)) == product["sha256"]
            for name, product in record["products"].items()
        )

    def finish(self, key, digest, names, *, seconds):
        """Record that a stage is done, with the checksums of its products."""
        products = {
            name: {"sha256": file_sha256(self.path(name)), "bytes": self.path(name).stat().st_size}
            for name in names
        }
        self.records[key] = {"hash": digest, "seconds": round(seconds, 2), "products": products}
        self._write_manifest()

    def drop(self, key):
        """Forget a stage's record and remove the products that it names."""
        for name in self.records.pop(key, {}).get("products", {}):
            self.path(name).unlink(missing_ok=True)

    def checksums(self, stage):
        """Checksums of all products of a stage, over its units."""
        return {
            name: product["sha256"]
            for key, record in sorted(self.records.items())
            if key.split(":")[0] == stage
            for name, product in record["products"].items()
        }

    def _write_manifest(self):
        self.save(
            MANIFEST,
            lambda path: path.write_text(
                json.dumps({"stages": self.records}, indent=1), encoding="utf-8"
            ),
        )


def _read_manifest(path):
    """The records of a manifest, checked."""
    try:
        records = json.loads(path.read_text(encoding="utf-8"))["stages"]
        for record in records.values():
            record["hash"], record["seconds"]
            for product in record["products"].values():
                product["sha256"], product["bytes"]
    except (ValueError, KeyError, TypeError, AttributeError) as err:
        msg = f"{path} is not the manifest of a run ({type(err).__name__}: {err})"
        raise DataError(msg) from None
    return records


def _alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
