"""
Reading of the files of GALAXEV (Bruzual & Charlot 2003 and later), binary and ASCII.

A binary ``.ised`` file is a Fortran unformatted file of four-byte numbers, in either byte
order; ``.ised_ASCII`` is the same, written with Fortran's list-directed format, the texts on
lines of their own. `_content` has the order of the numbers.
"""

import gzip
import itertools
import re
import struct
import zlib
from dataclasses import field
from pathlib import Path

import numpy as np

from miricigale.utils.exceptions import data_error
from miricigale.utils.files import unpacked_size
from miricigale.utils.package_tables import declared
from miricigale.utils.units import is_ascending
from miricigale.utils.values import value_class

#: Quantities after the spectra, in their order.
QUANTITIES = declared("miricigale.refdata.libraries", "formats.toml")["ised"]["quantities"]
N_NEEDED = 10  # of them; later versions go on

_LAWS = {0: "single burst (SSP)", 4: "exponential", 6: "delayed"}
_MOST_AGES = 10**5
_MOST_NUMBERS = 10**7
_TEXT = 80


@value_class
class Ised:
    """
    Content of a file of GALAXEV, as it stands there.

    Parameters
    ----------
    age, wave : `~numpy.ndarray`, shape (n_age,) and (n_wave,)
        Ages in yr, wavelengths in A.
    spectra : `~numpy.ndarray`, shape (n_age, n_wave)
        L_lambda in Lsun/A, float32.
    quantities : dict of str to `~numpy.ndarray`, shape (n_age,)
        ``bolometric`` (Lsun), ``mass`` (Msun), ``sfr`` (Msun/yr), ``remnants`` (Msun) and so on.
    mass_limits, slopes : tuple of float
        Of the IMF: Msun, and exponents x of its segments (dn/dlogm ~ m^-x), none if it is no
        power law.
    law, tau : int, float
        Star-formation law (0 a single burst, 4 exponential, 6 delayed, others), its time in yr.
    texts : tuple of str
        The lines of text.
    """

    age: np.ndarray
    wave: np.ndarray
    spectra: np.ndarray
    quantities: dict
    mass_limits: tuple
    slopes: tuple
    law: int
    tau: float
    texts: tuple = field(default=())

    @property
    def history(self):
        """The star-formation law in words."""
        words = _LAWS.get(self.law, f"law {self.law}")
        if self.law:
            return f"{words}, tau {self.tau / 1e9:g} Gyr"
        return words

    @property
    def metallicity(self):
        """Mass fraction of metals that the texts state, or None."""
        metallicities = {
            float(z) for text in self.texts for z in re.findall(r"\bZ\s*=\s*(\d*\.\d+)", text)
        }
        if len(metallicities) == 1:
            return metallicities.pop()
        return None


def read_ised(path):
    """
    Read any file of GALAXEV, of a single burst or a composite population.

    Parameters
    ----------
    path : path-like
        A file ``.ised`` (either byte order) or ``.ised_ASCII``, as it is or compressed by gzip;
        the content decides, not the name.

    Returns
    -------
    content : `Ised`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If it is another file, truncated or not finite.
    """
    path = Path(path)
    data = _unpacked(path)
    order = _byte_order(data)
    if order is None:
        source = _Words(data, path)
    else:
        source = _Records(data, order, path)
    out = _content(source)
    for name, array in (("ages", out.age), ("wavelengths", out.wave)):
        if not is_ascending(array, min_size=2) or array[0] < 0:
            raise _foreign(path, f"{name} must be positive and ascending")
    for name, array in (("spectra", out.spectra), *out.quantities.items()):
        if not np.all(np.isfinite(array)):
            raise _foreign(path, f"{name} must be finite")
    if out.spectra.min() < 0:
        raise _foreign(path, f"spectra must be 0 or more, got {out.spectra.min():g}")
    return out


def _unpacked(path):
    """Return the content of a file, decompressed if it is compressed by gzip."""
    unpacked_size(path)
    try:
        data = path.read_bytes()
        if data[:2] == b"\x1f\x8b":
            return gzip.decompress(data)
        return data
    except (OSError, EOFError, zlib.error) as err:
        raise _foreign(path, err) from err


def _content(source):
    """Return the numbers of a file in their order, whatever its form."""
    source.begin("the head")
    age = source.vector().astype(float)
    limits = tuple(source.floats(2).tolist())
    slopes = tuple(round(float(source.floats(6)[0]), 6) for _ in range(source.integer()))
    source.floats(3)  # mass, number of stars and mean mass of the IMF
    law = source.integer()
    tau = float(source.floats(1)[0])
    texts = source.texts()
    source.begin("wavelengths")
    wave = source.vector().astype(float)
    spectra = np.empty((age.size, wave.size), dtype=np.float32)
    for i, row in enumerate(spectra, 1):
        source.begin(f"spectrum {i} of {age.size}")
        row[:] = source.vector(wave.size)
        source.indices()
    vectors = []
    while len(vectors) < N_NEEDED or not source.ended():
        source.begin(f"vector {len(vectors) + 1} after the spectra")
        vectors.append(source.vector(age.size).astype(float))
    quantities = dict(zip(QUANTITIES, vectors, strict=False))
    return Ised(age, wave, spectra, quantities, limits, slopes, law, tau, tuple(texts))


def _foreign(path, why):
    return data_error(path, f"cannot be read as a file of GALAXEV: {why}")


def _truncated(path, place):
    return _foreign(path, f"it ends {place}: truncated")


class _Source:
    """Numbers of a file, read from its beginning; `begin` starts a record."""

    def __init__(self, path):
        self.path = path
        self.title = ""

    def begin(self, title):
        self.title = title

    def integer(self):
        return int(self.numbers("i4", 1)[0])

    def floats(self, n):
        return self.numbers("f4", n)

    def vector(self, n=None):
        """Return the numbers after their count, which may be known."""
        count = self.integer()
        if not 0 <= count < _MOST_NUMBERS or (n is not None and count != n):
            wanted = n
            if n is None:
                wanted = "a count of"
            raise _foreign(self.path, f"{self.title} must hold {wanted} numbers, got {count}")
        return self.floats(count)

    def indices(self):
        """Fluxes for spectral indices."""
        self.vector()


# --------------------------------------------------------------------------- binary


def _byte_order(data):
    """Return ``"<"`` or ``">"`` if it begins like a record of Fortran, else None."""
    for order in "<>":
        if len(data) < 12:
            return None
        size, count = map(int, np.frombuffer(data, f"{order}i4", 2))
        if 1 < count < _MOST_AGES and 4 * count + 60 <= size < 4 * count + 2000:
            return order
    return None


def _records(data, order, path):
    """Return the contents of the records, between their lengths."""
    length = struct.Struct(f"{order}i")
    at = 0
    out = []
    while at < len(data):
        place = f"record {len(out) + 1}"
        try:
            (size,) = length.unpack_from(data, at)
            (trailer,) = length.unpack_from(data, at + 4 + size)
        except struct.error:
            raise _truncated(path, f"in {place}") from None
        if size < 0 or trailer != size:
            raise _foreign(path, f"the lengths before and after {place} differ")
        out.append(data[at + 4 : at + 4 + size])
        at += size + 8
    return out


class _Records(_Source):
    """Records of Fortran's unformatted output."""

    def __init__(self, data, order, path):
        super().__init__(path)
        self.records = _records(data, order, path)
        self.order = order
        self.number = 0

    def begin(self, title):
        if self.ended():
            raise _truncated(self.path, f"after {self.number} records, before {title}")
        self.data = self.records[self.number]
        self.at = 0
        self.number += 1
        self.title = f"record {self.number}"

    def ended(self):
        return self.number == len(self.records)

    def numbers(self, kind, n):
        if self.at + 4 * n > len(self.data):
            got = f"{len(self.data)} bytes"
            raise _foreign(self.path, f"{self.title} must hold {n} numbers more, got {got}")
        self.at += 4 * n
        return np.frombuffer(self.data, self.order + kind, n, self.at - 4 * n).astype(kind)

    def indices(self):
        # they need not be there
        if self.at < len(self.data):
            self.vector()

    def texts(self):
        places = [self.at]
        if len(self.data) - self.at >= 16 + 3 * _TEXT:
            # four times lie between
            places += [self.at + _TEXT + 16, self.at + 2 * _TEXT + 16]
        texts = []
        for start in places:
            texts.append(self.data[start : start + _TEXT].decode("latin-1").strip())
        return texts


# ---------------------------------------------------------------------------- ASCII


class _Words(_Source):
    """Numbers and lines of Fortran's list-directed output."""

    def __init__(self, data, path):
        super().__init__(path)
        if b"\0" in data[:4096] or re.match(rb"\s*\d+\s", data) is None:
            raise _foreign(path, "wanted a record of Fortran or a count of ages at its beginning")
        text = data.decode("latin-1")
        if not text.endswith("\n"):
            raise _truncated(path, "within a line")
        self.lines = iter(text.splitlines())
        self.words = itertools.chain.from_iterable(map(_repeated, self.lines))

    def ended(self):
        following = list(itertools.islice(self.words, 1))
        self.words = itertools.chain(following, self.words)
        return not following

    def _take(self, n):
        words = list(itertools.islice(self.words, n))
        if len(words) < n:
            raise _truncated(self.path, f"within {self.title}")
        return words

    def numbers(self, kind, n):
        try:
            return np.array(self._take(n), dtype=kind)
        except ValueError as err:
            raise _foreign(self.path, f"{self.title} must be numbers: {err}") from err

    def texts(self):
        self._take(6)  # four times, a number and a truth value
        texts = []
        for line in itertools.islice(self.lines, 3):
            texts.append(line.strip())
        return texts


def _repeated(line):
    """Return the words of a line with Fortran's repeat counts, such as ``3*0.0``."""
    if "*" not in line:
        return line.split()
    out = []
    for word in line.split():
        times, star, value = word.partition("*")
        out += [value] * int(times) if star and times.isdigit() else [word]
    return out
