"""The work of an exposure: effects that act on blocks of rows, side by side."""

import functools

import numpy as np

from miricigale.detector._core.charge import add_poisson
from miricigale.detector.effects.base import Block, WholeBlock
from miricigale.detector.effects.charge import Dark, Saturation
from miricigale.detector.effects.cosmic_rays import CosmicRays
from miricigale.detector.effects.light import Photons
from miricigale.detector.effects.order import ORDER
from miricigale.instrument import DetectorProperties, Exposure
from miricigale.utils.parallel import chunks, parallel_map, threads
from miricigale.utils.values import value_class

#: What makes the charge of a pixel, whenever it comes within the exposure; cosmic rays apart.
_COLLECTING = tuple(kind for kind in ORDER[: ORDER.index(Saturation)] if kind is not CosmicRays)

# rows whose charge is collected at once
_ROWS = 128

# samples (float32) that one thread has in hand: a few MB, so that they stay in the cache
_BLOCK_SAMPLES = 2**21


@value_class(repr=False)
class Work:
    """
    One exposure: its effects act on blocks of rows, side by side.

    Parameters
    ----------
    light : `~numpy.ndarray`, shape (ny, nx)
        Surface brightness (MJy/sr).
    exposure : `~miricigale.instrument.Exposure`
        How it is exposed.
    properties : `~miricigale.instrument.DetectorProperties`
        Of the detector.
    keyed : tuple of (effect, key)
        The effects that act, in order, with the keys of their random numbers.
    previous : tuple of `~miricigale.detector.Latent`
        Exposures before.
    meta : dict
        Provenance.
    """

    light: np.ndarray
    exposure: Exposure
    properties: DetectorProperties
    keyed: tuple
    previous: tuple
    meta: dict

    @property
    def effects(self):
        return tuple(effect for effect, _ in self.keyed)

    @property
    def shape(self):
        e = self.exposure
        return (e.n_integrations, e.n_groups) + e.shape

    @functools.cached_property
    def frames(self):
        """The exposure that the effects see: each frame is a group of it."""
        return self.exposure.of_frames()

    def run(self, store, n_threads, progress_bar):
        """Expose all rows, block by block; each block is handed to ``store``."""
        n_int, nx = self.shape[0], self.shape[3]
        height = max(1, _BLOCK_SAMPLES // (n_int * self.frames.n_groups * nx))

        def work(rows):
            store(rows, *self._exposed(rows))

        self._each_block(work, height, "ramp", n_threads, progress_bar)

    def _each_block(self, work, height, desc, n_threads, progress_bar):
        """Call a function of blocks of so many rows, side by side; returns what it returns."""
        desc = f"{desc} {self.exposure.filter}"
        blocks = chunks(self.shape[2], height)
        with threads(n_threads) as executor:
            return parallel_map(
                work, blocks, executor=executor, progress_bar=progress_bar, desc=desc
            )

    def collect(self, n_threads, progress_bar):
        """Collect the charge of all rows: mean rate, electrons, places and charge of hits, flags of pixels."""
        shape = self.shape[2:]
        mean = np.empty(shape)
        electrons = np.empty(shape, np.float32)
        pixel_dq = np.zeros(shape, np.uint32)

        def work(rows):
            mean[rows], electrons[rows], pixel_dq[rows], *hits = self._collected(rows)
            return hits

        hits = self._each_block(work, _ROWS, "charge", n_threads, progress_bar)
        places = np.concatenate([positions for positions, _ in hits], axis=1)
        return mean, electrons, places, np.concatenate([charge for _, charge in hits]), pixel_dq

    def _with_halo(self, rows, chain):
        """Return the rows that the effects of a chain need for some rows, and where these are in them."""
        halo = sum(effect.halo for effect, _ in chain)
        wide = slice(max(rows.start - halo, 0), min(rows.stop + halo, self.light.shape[0]))
        return wide, slice(rows.start - wide.start, rows.stop - wide.start)

    def _exposed(self, rows):
        """Apply the effects to some rows: counts, flags of pixels, flags of groups."""
        wide, inner = self._with_halo(rows, self.keyed)
        shape = (self.shape[0], self.frames.n_groups, wide.stop - wide.start, self.shape[3])
        pixel_dq = np.zeros(shape[2:], np.uint32)
        group_dq = np.zeros(shape, np.uint8)
        make_block = functools.partial(
            Block, self.frames, self.properties, wide, pixel_dq, group_dq
        )
        _, array, later = self._lit(make_block, self.light[wide], self.keyed)
        for effect, key in later:
            array = effect.apply(array, make_block(key, self.previous))
        counts, flags = array[:, :, inner], group_dq[:, :, inner]
        if self.exposure.n_frames > 1:
            counts, flags = _averaged(counts, flags, self.exposure.n_frames)
        return counts, pixel_dq[inner], flags

    def _lit(self, make_block, light, chain):
        """
        Draw the electrons of light and dark current together: a sum of Poisson numbers is one.

        Returns the mean rate, the ramp, and the effects of the chain that are left.
        """
        n = next(i for i, (effect, _) in enumerate(chain) if isinstance(effect, Photons))
        for effect, key in chain[:n]:
            light = effect.apply(light, make_block(key))
        block = make_block(chain[n][1])
        mean = chain[n][0].expected(light, block)
        if type(chain[n][0]).apply is not Photons.apply:
            # a kind of its own, that may draw otherwise
            return mean, chain[n][0].apply(light, block), chain[n + 1 :]
        for effect, key in chain[n + 1 :]:
            if type(effect).apply is not Dark.apply:
                break
            mean = effect.expected(mean, make_block(key))
            n += 1
        ramp = np.zeros(block.ramp_shape, np.float32)
        electrons = np.ascontiguousarray(mean * block.group_time, float)
        add_poisson(ramp, electrons, block.key, block.rows.start)
        return mean, ramp, chain[n + 1 :]

    def _collected(self, rows):
        """Collect the charge of some rows: mean rate, electrons, flags of pixels, hits."""
        chain = [(effect, key) for effect, key in self.keyed if isinstance(effect, _COLLECTING)]
        wide, inner = self._with_halo(rows, chain)
        shape = (wide.stop - wide.start, self.shape[3])
        pixel_dq = np.zeros(shape, np.uint32)
        flags = np.zeros((1, 1) + shape, np.uint8)
        make_block = functools.partial(
            WholeBlock, self.exposure, self.properties, wide, pixel_dq, flags
        )
        mean, ramp, later_effects = self._lit(make_block, self.light[wide], chain)
        for effect, key in later_effects:
            block = make_block(key, self.previous)
            mean = effect.expected(mean, block)
            ramp = effect.apply(ramp, block)
        hits = (np.empty((3, 0), np.int32), np.empty(0))
        flags = np.broadcast_to(np.uint8(0), self.shape[:2] + (rows.stop - rows.start, shape[1]))
        for effect, key in self.keyed:
            if isinstance(effect, CosmicRays):
                # the shape alone is used of its flags
                hits = effect.hits(
                    Block(self.exposure, self.properties, rows, pixel_dq, flags, key)
                )
        return mean[inner], ramp[0, 0, inner], pixel_dq[inner], *hits


def _averaged(counts, flags, n_frames):
    """
    Average frames to groups as on board: sums of counts, shifted by the bits of ``n_frames``, a power of two.

    A group has the flags of its frames. The sum is rounded down.
    """
    n_int, n_all = counts.shape[:2]
    parts = (n_int, n_all // n_frames, n_frames) + counts.shape[2:]
    total = counts.reshape(parts).sum(axis=2, dtype=np.uint32)
    shift = n_frames.bit_length() - 1
    return (total >> shift).astype(counts.dtype), np.bitwise_or.reduce(flags.reshape(parts), axis=2)
