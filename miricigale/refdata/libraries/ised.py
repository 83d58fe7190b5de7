"""
Reading of the files of GALAXEV (Bruzual & Charlot 2003 and later), binary and ASCII.

A binary ``.ised`` file is a Fortran unformatted file of four-byte numbers, in either byte
order. Its records are: a head (number of ages, ages in yr, IMF, star-formation law, three
lines of text), wavelengths in A, a spectrum in Lsun/A for each age, followed in the same
record by a short vector of fluxes for spectral indices, and then quantities as functions of
age, each with its count: bolometric flux, mass in stars, star-formation rate, evolutionary
flux, rates of supernovae and of planetary nebulae, numbers of black holes, neutron stars and
white dwarfs, mass of remnants; later versions go on (turn-off mass, flux of the main
sequence, mass of gas, mass of the galaxy ...). ``.ised_ASCII`` is the same, written with
Fortran's list-directed format, the texts on lines of their own.
"""

import gzip
import re
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from miricigale.utils.exceptions import DataError
from miricigale.utils.files import unpacked_size

__all__ = ["Ised", "read_ised"]

#: Quantities after the spectra, in their order.
QUANTITIES = (
    "bolometric",
    "mass",
    "sfr",
    "evolutionary",
    "supernovae",
    "planetary_nebulae",
    "black_holes",
    "neutron_stars",
    "white_dwarfs",
    "remnants",
    "turn_off",
    "main_sequence",
    "gas",
    "galaxy",
)
N_NEEDED = 10

_LAWS = {0: "single burst (SSP)", 4: "exponential", 6: "delayed"}
_MOST_AGES = 100000
_TEXT = 80


@dataclass(frozen=True, eq=False)
class Ised:
    """
    Content of a file of GALAXEV, as it stands there.

    Parameters
    ----------
    name : str
        Name of the file.
    age : `~numpy.ndarray`, shape (n_age,)
        Ages in yr.
    wave : `~numpy.ndarray`, shape (n_wave,)
        Wavelengths in A.
    spectra : `~numpy.ndarray`, shape (n_age, n_wave)
        L_lambda in Lsun/A, float32.
    quantities : dict of str to `~numpy.ndarray`, shape (n_age,)
        ``bolometric`` (Lsun), ``mass`` (Msun), ``sfr`` (Msun/yr), ``remnants`` (Msun) and so on.
    mass_limits : tuple of float
        Of the IMF, in Msun.
    slopes : tuple of float
        Exponents x of the segments of the IMF (dn/dlogm ~ m^-x); empty if it is no power law.
    law : int
        Star-formation law: 0 a single burst, 4 exponential, 6 delayed, others.
    tau : float
        Time of the law in yr.
    texts : tuple of str
        The lines of text.
    """

    name: str
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
    def is_ssp(self):
        """Whether it is a single burst."""
        return self.law == 0

    @property
    def history(self):
        """The star-formation law in words."""
        words = _LAWS.get(self.law, f"law {self.law}")
        return words if self.is_ssp else f"{words}, tau {self.tau / 1e9:g} Gyr"

    @property
    def metallicity(self):
        """Mass fraction of metals that the texts state, or None."""
        found = {float(z) for text in self.texts for z in re.findall(r"\bZ\s*=\s*(\d*\.\d+)", text)}
        return found.pop() if len(found) == 1 else None


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
    return parse_ised(read_bytes(path), path)


def read_bytes(path):
    """Content of a file, decompressed if it is compressed by gzip."""
    unpacked_size(path)
    try:
        data = path.read_bytes()
        return gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
    except (OSError, EOFError, zlib.error) as err:
        raise _foreign(path, err) from err


def parse_ised(data, path):
    """Like `read_ised`, from the decompressed content; ``path`` is for messages."""
    order = _byte_order(data)
    parts = _ascii_parts(data, path) if order is None else _binary_parts(data, order, path)
    head, wave, spectra, vectors = parts
    quantities = dict(zip(QUANTITIES, vectors, strict=False))
    out = Ised(path.name, head.pop("age"), wave, spectra, quantities, **head)
    for name, array in (("ages", out.age), ("wavelengths", out.wave)):
        if array.size < 2 or not np.all(np.diff(array) > 0) or array[0] < 0:
            raise _foreign(path, f"{name} must be positive and ascending")
    for name, array in (("spectra", spectra), *quantities.items()):
        if not np.all(np.isfinite(array)):
            raise _foreign(path, f"{name} must be finite")
    if spectra.min() < 0:
        raise _foreign(path, f"spectra must be 0 or more, got {spectra.min():g}")
    return out


def _foreign(path, why):
    return DataError(f"{path} cannot be read as a file of GALAXEV: {why}")


def _truncated(path, where):
    return _foreign(path, f"it ends {where}: truncated")


# --------------------------------------------------------------------------- binary


def _byte_order(data):
    """``"<"`` or ``">"`` if it begins like a record of Fortran, else None."""
    for order in "<>":
        if len(data) < 12:
            return None
        size, count = (int(x) for x in np.frombuffer(data, f"{order}i4", 2))
        if 1 < count < _MOST_AGES and 4 * count + 60 <= size < 4 * count + 2000:
            return order
    return None


def _records(data, order, path):
    """Contents of the records."""
    at, out = 0, []
    while at < len(data):
        where = f"in record {len(out) + 1}"
        if at + 4 > len(data):
            raise _truncated(path, where)
        size = int(np.frombuffer(data, f"{order}i4", 1, at)[0])
        if size < 0:
            raise _foreign(path, f"record {len(out) + 1} has a length of {size} bytes")
        if at + size + 8 > len(data):
            raise _truncated(path, where)
        if int(np.frombuffer(data, f"{order}i4", 1, at + 4 + size)[0]) != size:
            raise _foreign(path, f"the lengths before and after record {len(out) + 1} differ")
        out.append(data[at + 4 : at + 4 + size])
        at += size + 8
    return out


class _Record:
    """One record, read from its beginning."""

    def __init__(self, data, order, path, title):
        self.data, self.order, self.path, self.title = data, order, path, title
        self.at = 0

    def take(self, kind, n):
        if n < 0 or self.at + 4 * n > len(self.data):
            got = f"{len(self.data)} bytes"
            raise _foreign(self.path, f"{self.title} must hold {n} numbers more, got {got}")
        out = np.frombuffer(self.data, self.order + kind, n, self.at)
        self.at += 4 * n
        return out

    def integer(self):
        return int(self.take("i4", 1)[0])

    def floats(self, n):
        return self.take("f4", n).astype(np.float32)

    def vector(self, n=None):
        count = self.integer()
        if n is not None and count != n:
            raise _foreign(self.path, f"{self.title} must hold {n} numbers, got {count}")
        return self.floats(count)

    def text(self):
        out = self.data[self.at : self.at + _TEXT]
        self.at += _TEXT
        return out.decode("latin-1").strip()

    @property
    def left(self):
        return len(self.data) - self.at


def _binary_parts(data, order, path):
    records = [
        _Record(record, order, path, f"record {i}")
        for i, record in enumerate(_records(data, order, path), 1)
    ]
    head = records[0]
    age = head.vector().astype(float)
    limits, slopes = head.floats(2), [head.floats(6)[0] for _ in range(head.integer())]
    head.floats(3)  # mass, number of stars and mean mass of the IMF
    law, tau, texts = head.integer(), float(head.floats(1)[0]), [head.text()]
    if head.left >= 16 + 2 * _TEXT:
        head.floats(4)
        texts += [head.text(), head.text()]
    wanted = 2 + age.size + N_NEEDED
    if len(records) < wanted:
        raise _truncated(path, f"after {len(records)} of {wanted} or more records")
    wave = records[1].vector().astype(float)
    spectra = np.empty((age.size, wave.size), dtype=np.float32)
    for row, record in zip(spectra, records[2:], strict=False):
        row[:] = record.vector(wave.size)
        if record.left:
            record.vector()  # fluxes for indices
    vectors = [r.vector(age.size).astype(float) for r in records[2 + age.size :]]
    return _head(age, limits, slopes, law, tau, texts), wave, spectra, vectors


def _head(age, limits, slopes, law, tau, texts):
    return {
        "age": age,
        "mass_limits": tuple(float(x) for x in limits),
        "slopes": tuple(round(float(x), 6) for x in slopes),
        "law": law,
        "tau": tau,
        "texts": tuple(texts),
    }


# ---------------------------------------------------------------------------- ASCII


class _Words:
    """Numbers and lines of list-directed text, read from its beginning."""

    def __init__(self, data, path):
        self.path = path
        text = data.decode("latin-1")
        if not text.endswith("\n"):
            raise _truncated(path, "within a line")
        self.lines = text.splitlines()
        self.at, self.words = 0, []

    def ended(self):
        """Whether nothing but white space is left."""
        return not self.words and not any(line.strip() for line in self.lines[self.at :])

    def take(self, n, title):
        """Take n words; what is left of their last line waits."""
        blocks, have = [self.words], len(self.words)
        while have < n:
            if self.at >= len(self.lines):
                raise _truncated(self.path, f"within {title}")
            line = self.lines[self.at]
            self.at += 1
            blocks.append(_repeated(line) if "*" in line else line.split())
            have += len(blocks[-1])
        words = [word for block in blocks for word in block]
        self.words = words[n:]
        return words[:n]

    def floats(self, n, title):
        words = self.take(n, title)
        try:
            return np.array(words, dtype=np.float32)
        except ValueError as err:
            raise _foreign(self.path, f"{title} must be numbers: {err}") from err

    def integer(self, title):
        word = self.take(1, title)[0]
        try:
            return int(word)
        except ValueError:
            raise _foreign(self.path, f"{title} must begin with a count, got {word!r}") from None

    def vector(self, title, n=None):
        count = self.integer(title)
        if not 0 <= count < 10**7 or (n is not None and count != n):
            wanted = "a count" if n is None else n
            raise _foreign(self.path, f"{title} must hold {wanted} numbers, got {count}")
        return self.floats(count, title)

    def text(self):
        if self.words or self.at >= len(self.lines):
            raise _foreign(self.path, "three lines of text must follow the numbers of its head")
        self.at += 1
        return self.lines[self.at - 1].strip()


def _repeated(line):
    """Words of a line with Fortran's repeat counts, such as ``3*0.0``."""
    out = []
    for word in line.split():
        times, star, value = word.partition("*")
        out += [value] * int(times) if star and times.isdigit() else [word]
    return out


def _ascii_parts(data, path):
    if b"\0" in data[:4096] or not data[:4096].split()[:1] or not data.split(None, 1)[0].isdigit():
        wanted = "wanted a record of Fortran or a count of ages at its beginning"
        raise _foreign(path, wanted)
    words = _Words(data, path)
    age = words.vector("ages").astype(float)
    limits = words.floats(2, "the IMF")
    segments = words.integer("the IMF")
    slopes = [words.floats(6, "the IMF")[0] for _ in range(segments)]
    words.floats(3, "the IMF")
    law = words.integer("the star-formation law")
    tau = float(words.floats(1, "the star-formation law")[0])
    words.take(6, "the star-formation law")  # four times, a number and a truth value
    texts = [words.text() for _ in range(3)]
    wave = words.vector("wavelengths").astype(float)
    spectra = np.empty((age.size, wave.size), dtype=np.float32)
    for i, row in enumerate(spectra, 1):
        row[:] = words.vector(f"spectrum {i} of {age.size}", wave.size)
        words.vector(f"the indices of spectrum {i} of {age.size}")
    vectors = []
    while len(vectors) < N_NEEDED or not words.ended():
        title = f"vector {len(vectors) + 1} after the spectra"
        vectors.append(words.vector(title, age.size).astype(float))
    return _head(age, limits, slopes, law, tau, texts), wave, spectra, vectors
