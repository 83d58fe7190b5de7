"""Random streams with one owner and a key, so that order and workers change nothing."""

import hashlib

import numpy as np

from miricigale.utils.exceptions import argument_error


def text_key(text):
    """
    Turn a text (a filter's name, a source's id) into 64 bits that never change.

    Parameters
    ----------
    text : object
        Anything with a stable `str`.

    Returns
    -------
    key : int
        The first 64 bits of the sha256 of the text.
    """
    return int.from_bytes(hashlib.sha256(str(text).encode()).digest()[:8], "big")


def check_seed(seed):
    """
    Return ``seed`` as an int, drawing a fresh one for None.

    Raises
    ------
    ValueError
        If ``seed`` is neither None, a non-negative integer nor a Generator.
    """
    if seed is None:
        return int(np.random.SeedSequence().entropy)
    if isinstance(seed, np.random.Generator):
        return int(seed.integers(2**63))
    if isinstance(seed, (bool, float)) or not hasattr(seed, "__index__") or int(seed) < 0:
        raise argument_error("seed", "a non-negative integer, a Generator or None", repr(seed))
    return int(seed)


def stream(seed, *key):
    """
    Make the random generator of one piece of work.

    Parameters
    ----------
    seed : int
        Seed of the whole run (see `check_seed`).
    *key : int or str
        What the stream is for: stage, filter, dither, source id. Text is hashed with
        `text_key`. The same seed and key give the same stream anywhere.

    Returns
    -------
    generator : `~numpy.random.Generator`
    """
    words = []
    for part in key:
        if isinstance(part, (int, np.integer)):
            number = int(part)
        else:
            number = text_key(part)
        # spawn keys are sequences of 32-bit words: two for each part, whatever its size
        words += divmod(number % 2**64, 2**32)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(words)))
