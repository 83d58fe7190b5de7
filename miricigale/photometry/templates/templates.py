"""Templates: the light of each source of the high-resolution image, as seen on another image."""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from concurrent.futures import Executor

import numpy as np
import scipy.fft

from miricigale.photometry._core.sampling import (
    box_response,
    convolve_batch,
    sample_stamps,
    spline_response,
)
from miricigale.photometry._core.stamps import add_model
from miricigale.photometry.detection.cutouts import RIM, convolve_padded
from miricigale.photometry.images.arrays import stamp_starts
from miricigale.utils.caching import cached
from miricigale.utils.memory import return_freed_memory
from miricigale.utils.parallel import parallel_map
from miricigale.utils.values import value_class

#: Pixels of the stamps that a thread works on at a time, and how many times as many are in a block.
_PART = 250_000
_PARTS_OF_BLOCK = 16


#: Stands for a cutout that was dropped; None would be a point.
_DROPPED = object()


@value_class
class FineTemplates:
    """Convolve cutouts on the fine grid, as spline coefficients."""

    #: (n, n) or (k, n, n): Matching kernel, and PSF of the image on the fine grid; of all places
    #: of the field.
    kernel: np.ndarray
    target: np.ndarray
    #: (2, 2): Sides of the image's pixel in fine pixels, if templates are to be averaged over it;
    #: None without.
    sides: np.ndarray | None = None

    def __post_init__(self):
        for name in ("kernel", "target"):
            value = np.asarray(getattr(self, name), float)
            object.__setattr__(self, name, value.reshape(-1, *value.shape[-2:]))

    def _response(self, shape):
        response = 1.0 / spline_response(shape)
        if self.sides is not None:
            response = response * box_response(shape, self.sides)
        return response

    @functools.cached_property
    def _points(self):
        """Coefficients of the point source at each place, shape (k, h, w), its center in the middle."""
        coefficients = [convolve_padded(psf, self._response) for psf in self.target]
        return np.concatenate(coefficients, dtype=np.float32)

    def points(self, weights):
        """
        Return coefficients of point sources, (m, h, w), the center in the middle, and the number of each source's.

        ``weights``, (n, k), are what each place's PSF counts for each source.
        """
        if len(self.target) == 1:
            return self._points, np.zeros(len(weights), int)
        alike, member = np.unique(weights, axis=0, return_inverse=True)
        return np.tensordot(np.float32(alike), self._points, axes=1), member.reshape(-1)

    @functools.cached_property
    def kernel_power(self):
        """Sums of products of the kernels of two places, with the pixel's response, shape (k, k)."""
        kernels = self.kernel
        if self.sides is not None:
            response = functools.partial(box_response, sides=self.sides)
            kernels = np.concatenate([convolve_padded(kernel, response) for kernel in kernels])
        flat = kernels.reshape(len(kernels), -1)
        return flat @ flat.T

    @cached(maxsize=256)
    def _transfer(self, shape, convolved, place):
        if convolved:
            # light with the sharp PSF is convolved with the matching kernel
            transfer = scipy.fft.rfft2(self.kernel[place], s=shape)
        else:
            # a profile is integrated over fine pixels already, which the PSF's samples are not
            transfer = scipy.fft.rfft2(self.target[place], s=shape)
            transfer /= box_response(shape, np.eye(2))
        return np.complex64(transfer * self._response(shape))

    def _transfers(self, shape, convolved, weights):
        """Return the transform of the kernel for each of some sources, or one for all if they are alike."""
        places = np.flatnonzero(weights.any(axis=0))
        transfers = [self._transfer(shape, convolved, int(k)) for k in places]
        if len(places) == 1:
            return transfers[0]
        parts = zip(np.float32(weights.T[places]), transfers, strict=True)
        total = 0
        for weight, transfer in parts:
            total = total + weight[:, None, None] * transfer
        return total

    def _size(self, cutout):
        """Return the size (y, x), in fine pixels, of the kernel or PSF that a cutout is convolved with."""
        return (self.kernel if cutout.convolved else self.target).shape[1:]

    def shape(self, cutout):
        """Return the shape of the transform for a cutout, rounded up so that many share it."""
        sizes = np.add(cutout.shape, self._size(cutout)) - 1 + 2 * RIM
        ny, nx = (-(-sizes // 16) * 16).tolist()
        return scipy.fft.next_fast_len(ny, True), scipy.fft.next_fast_len(nx, True)

    def corner(self, cutout):
        """Return the fine pixel (x, y) of the first coefficient of a convolved cutout."""
        return np.array(cutout.origin[::-1]) - self._size(cutout)[0] // 2 - RIM

    def sides_of(self, cutout):
        """Return the first and last fine (x, y) that the light of a convolved cutout reaches."""
        first = self.corner(cutout) + RIM - 1.0
        return first, first + np.add(cutout.shape, self._size(cutout))[::-1]

    def coefficients(self, group, shape, weights):
        """Convolve cutouts of one shape, returning an array of shape (n, *shape)."""
        height, width = np.max([cutout.shape for cutout in group], axis=0) + RIM
        stamps = np.zeros((len(group), height, width), np.float32)
        for stamp, cutout in zip(stamps, group, strict=True):
            h, w = cutout.shape
            stamp[RIM : RIM + h, RIM : RIM + w] = cutout.data
        transfer = self._transfers(shape, group[0].convolved, weights)
        return convolve_batch(stamps, transfer, shape)


@value_class
class Block:
    """Some templates as flat stamps: rows ``first ... first + len(box)`` of the bank."""

    first: int
    box: np.ndarray
    start: np.ndarray
    values: np.ndarray

    @property
    def last(self):
        """Row after the last."""
        return self.first + len(self.box)

    @property
    def end(self):
        """Row of the image after the last that a stamp reaches."""
        return int((self.box[:, 0] + self.box[:, 2]).max())

    @property
    def stamps(self):
        """Values, boxes and starts, as the kernels take them."""
        return self.values, self.box, self.start

    def stamps_of(self, part):
        """Return `stamps` of a slice of the block's rows."""
        return self.values, self.box[part], self.start[part.start : part.stop + 1]

    def parts(self):
        """Cut the block's rows (0 for its first) into slices of some hundred thousand pixels each."""
        return _pieces(self.start, _PART)


def _pieces(start, size):
    """Cut stamps that begin at ``start`` in a flat array into slices of some ``size`` pixels each."""
    first = 0
    n = len(start) - 1
    while first < n:
        # at least one stamp, at most so many pixels
        last = int(np.searchsorted(start, start[first] + size, side="right")) - 1
        last = min(max(last, first + 1), n)
        yield slice(first, last)
        first = last


def batches(shapes):
    """
    Put stamps of one shape together, some hundred thousand pixels at a time.

    Yields each shape, as it was given (the shape of a stamp, or a tuple that begins with it; None for those
    left out), and the numbers of its stamps.
    """
    groups = {}
    for row, shape in enumerate(shapes):
        if shape is not None:
            groups.setdefault(shape, []).append(row)
    for shape, rows in groups.items():
        size = max(1, _PART // (shape[0] * shape[1]))
        for first in range(0, len(rows), size):
            yield shape, rows[first : first + size]


@value_class
class BankSources:
    """The sources of a bank."""

    cutout: list  # One for each source; None is a point source.
    #: (n, 2): Positions on the fine grid and on the image.
    fine_xy: np.ndarray
    xy: np.ndarray
    #: (n, 2, 6): Maps from image to fine pixels (see `~miricigale.photometry.images.arrays.local_maps`).
    poly: np.ndarray


@dataclasses.dataclass(eq=False, repr=False)
class TemplateBank:
    """
    All templates of an image, made block by block and kept only if memory allows.

    Rows are in the order of the stamps' first image rows, ``order`` gives the source of each.

    Parameters
    ----------
    fine, sources : `FineTemplates`, `BankSources`
        The convolution, and the sources.
    shape : (int, int)
        Shape of the image.
    max_bytes : float, optional
        Memory for stamps: if they need more they are made anew whenever needed.
    weigh : callable, optional
        Called with positions on the image, shape (m, 2): what the kernel of each place counts there,
        shape (m, k). Needed for several kernels.
    executor : `concurrent.futures.Executor`, optional
        Threads that the bank's `map` works with.
    once : bool, optional
        Whether cutouts are dropped as soon as their templates are made, if these are kept: they can then not be
        made anew, and no other bank can be made of this one.
    """

    fine: FineTemplates
    sources: BankSources
    shape: tuple
    max_bytes: float = 1.5e9
    weigh: Callable | None = None
    executor: Executor | None = None
    once: bool = False

    def __post_init__(self):
        sources = self.sources
        n = len(sources.cutout)
        self._weights = np.ones((n, 1))
        if self.weigh is not None:
            self._weights = self.weigh(sources.xy)
        box = self._boxes(self.shape)
        self.order = np.argsort(box[:, 0], kind="stable")
        self.box = np.ascontiguousarray(box[self.order])
        self.start = stamp_starts(self.box)
        self._kept = None
        self._same = {}

    def _boxes(self, shape):
        """Return boxes on the image that hold the fine stamps, cut to the image."""
        half = self.fine.target.shape[1] // 2 + 1
        # the fine rectangle that the light reaches: that of the PSF for points
        low = self.sources.fine_xy - half
        high = self.sources.fine_xy + half
        for k, cutout in enumerate(self.sources.cutout):
            if cutout is not None:
                sides = np.array([self.fine.sides_of(layer) for layer in cutout.layers])
                low[k] = sides[:, 0].min(axis=0)
                high[k] = sides[:, 1].max(axis=0)
        # the middle of the fine rectangle through the inverse of the linear map, and its half sides
        matrix = np.linalg.inv(self.sources.poly[:, :, 1:3])
        middle = 0.5 * (low + high) - self.sources.poly[:, :, 0]
        middle = np.einsum("kij,kj->ki", matrix, middle) + self.sources.xy
        reach = np.einsum("kij,kj->ki", np.abs(matrix), 0.5 * (high - low))
        first = np.clip(np.floor(middle - reach), 0, shape[::-1]).astype(int)
        last = np.clip(np.ceil(middle + reach) + 1, 0, shape[::-1]).astype(int)
        return np.hstack([first[:, ::-1], np.maximum(last - first, 0)[:, ::-1]])

    def shifted(self, shift):
        """Make the bank of the same sources moved by (dx, dy) image pixels."""
        moved = dataclasses.replace(self.sources, xy=self.sources.xy + shift)
        return dataclasses.replace(self, sources=moved)

    def with_points(self, xy, poly):
        """Make the bank of the same sources and, after them, of point sources at positions."""
        old = self.sources
        sources = BankSources(
            list(old.cutout) + [None] * len(xy),
            np.concatenate([old.fine_xy, poly[:, :, 0]]),
            np.concatenate([old.xy, xy]),
            np.concatenate([old.poly, poly]),
        )
        return dataclasses.replace(self, sources=sources)

    def at_resolution(self, rows, cutout):
        """Make the bank of cutouts that have the image's resolution, at some of the sources; it is made once."""
        unit = np.ones((1, 1))
        old = self.sources
        sources = BankSources(cutout, old.fine_xy[rows], old.xy[rows], old.poly[rows])
        fine = dataclasses.replace(self.fine, kernel=unit, target=unit)
        return dataclasses.replace(self, sources=sources, fine=fine, weigh=None, once=True)

    def reuse(self, bank):
        """
        Take the templates of another bank that are the same here: of the same numbers and places.

        The other forgets its own. Nothing is taken where memory does not hold both.
        """
        kept_blocks = bank._kept
        n = min(len(self.order), len(bank.order))
        bank.forget()
        if kept_blocks is None or 8.0 * self.start[-1] > self.max_bytes:
            return
        mine = self.sources
        theirs = bank.sources
        is_same = (mine.xy[:n] == theirs.xy[:n]).all(axis=1)
        is_same &= (mine.poly[:n] == theirs.poly[:n]).all(axis=(1, 2))
        self._same = {}
        for block in kept_blocks:
            for row, (start, end) in enumerate(itertools.pairwise(block.start)):
                source = bank.order[block.first + row]
                if source < n and is_same[source]:
                    self._same[source] = block.values[start:end]

    def parts(self, rows):
        """Return the cutouts of some rows, None for points."""
        return [self.sources.cutout[k] for k in self.order[rows]]

    def forget(self):
        """Free the templates that are kept; they are made anew if they are needed again."""
        self._kept = None
        self._same = {}

    def map(self, function, parts):
        """Call a function with each of some independent pieces of work, on the bank's threads."""
        parallel_map(function, parts, executor=self.executor)

    @property
    def xy(self):
        """Positions of the sources on the image, in the order of the rows."""
        return self.sources.xy[self.order]

    def noise_terms(self):
        """Return the sum over unit-weight pixels of the templates' variance by noise, by row."""
        noise = np.zeros(len(self.sources.cutout))
        for k, cutout in enumerate(self.sources.cutout):
            if cutout is not None:
                noise[k] = cutout.noise
        # image pixels in fine pixels
        area = np.abs(np.linalg.det(self.sources.poly[:, :, 1:3]))
        # sums of squares of each source's kernel
        power = np.einsum("nk,kl,nl->n", self._weights, self.fine.kernel_power, self._weights)
        return (noise * area * power)[self.order]

    def full_light(self):
        """Return the light of a whole point source, by row."""
        return (self._weights @ self.fine.target.sum(axis=(1, 2)))[self.order]

    def add_to(self, image, flux):
        """Add the templates, times fluxes (uJy, shape (n,)) in their order, to an image."""
        for block in self.blocks():
            part = flux[block.first : block.last]
            add_model(image, block.values, block.box, block.start, part)

    def blocks(self, *, last=False):
        """Yield all templates in order, as `Block` of some 16 MB each, dropped if it is the ``last`` time."""
        if self._kept is not None and last:
            blocks = self._kept[::-1]
            self.forget()
            while blocks:
                yield blocks.pop()
            return
        if self._kept is not None:
            yield from self._kept
            return
        keep = 4.0 * self.start[-1] <= self.max_bytes
        blocks = []
        for rows in _pieces(self.start, _PARTS_OF_BLOCK * _PART):
            block = self._make(rows.start, rows.stop)
            if keep:
                blocks.append(block)
            if keep and self.once:
                for source in self.order[rows]:
                    self.sources.cutout[source] = _DROPPED
                return_freed_memory()
            yield block
        if keep:
            self._kept = blocks
            self._same = {}

    def _make(self, first, last):
        fine = self.fine
        start = self.start[first : last + 1] - self.start[first]
        block = Block(first, self.box[first:last], start, np.zeros(int(start[-1]), np.float32))
        sources = self.order[first:last]
        # rows on the image, but for those that another bank has made already
        needed = (block.box[:, 2] > 0) & (block.box[:, 3] > 0)
        is_point = np.zeros(len(sources), bool)
        layers = []
        for row, source in enumerate(sources):
            cutout = self.sources.cutout[source]
            if cutout is None:
                is_point[row] = True
            else:
                layers += [(row, layer) for layer in cutout.layers]
            if source in self._same:
                # the other bank's block is freed with the last of its templates
                block.values[start[row] : start[row + 1]] = self._same.pop(source)
                needed[row] = False
        points = np.flatnonzero(is_point & needed)
        weights = self._weights[sources]

        def add(coefficients, member, amplitude, rows, origin):
            # sums of a piece in double precision, where each stamp begins anew
            box = block.box[rows]
            poly = self.sources.poly[sources[rows]]
            poly[:, :, 0] -= origin
            begin = stamp_starts(box)
            sums = np.zeros(int(begin[-1]))
            center = self.sources.xy[sources[rows]]
            sample_stamps(coefficients, member, amplitude, center, poly, box, begin, sums)
            for k, low, high in zip(rows, begin[:-1], begin[1:], strict=True):
                block.values[start[k] : start[k + 1]] += sums[low:high]

        def add_points(part):
            rows = np.intersect1d(points, np.arange(part.start, part.stop))
            if len(rows) == 0:
                return
            point, member = fine.points(weights[rows])
            middle = (np.array(point.shape[2:0:-1]) - 1) / 2
            # the middle of the PSF's coefficients is the source
            origin = self.sources.fine_xy[sources[rows]] - middle
            add(point, member, np.ones(len(rows)), rows, origin)

        def add_cutouts(batch):
            (ny, nx, _), members = batch
            rows = np.array([layers[k][0] for k in members])
            group = [layers[k][1] for k in members]
            origin = np.array(list(map(fine.corner, group)))
            coefficients = fine.coefficients(group, (ny, nx), weights[rows])
            add(coefficients, np.arange(len(rows)), np.ones(len(rows)), rows, origin)

        self.map(add_points, block.parts())
        # profiles first, what is added to them afterwards
        first_layers = [None] * len(layers)
        corrections = [None] * len(layers)
        for k, (row, layer) in enumerate(layers):
            if needed[row]:
                is_first = layer is self.sources.cutout[sources[row]]
                shapes = first_layers if is_first else corrections
                ny, nx = fine.shape(layer)
                shapes[k] = ny, nx, layer.convolved
        self.map(add_cutouts, batches(first_layers))
        self.map(add_cutouts, batches(corrections))
        return block
