"""Streams of random numbers: the key decides, and nothing else."""

import hashlib

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from helpers.errors import refuses
from miricigale.utils.random import check_seed, stream, text_key


def test_the_key_makes_the_stream():
    first = stream(1, "detector", "miri.f770w", 2).random(5)
    assert_array_equal(stream(1, "detector", "miri.f770w", 2).random(5), first)
    others = [(2, "detector", "miri.f770w", 2), (1, "detector", "miri.f770w", 3)]
    others += [(1, "detector", "miri.f1000w", 2), (1, "scene", "miri.f770w", 2)]
    others += [(1, "detector", 2, "miri.f770w"), (1, "detector", "miri.f770w")]
    for key in others:
        assert not np.any(stream(*key).random(5) == first), key


def test_streams_are_independent():
    # the sum of n independent uniform draws has variance n / 12
    draws = np.array([stream(0, "source", i).random(20) for i in range(500)])
    assert abs(draws.sum(axis=0).var() / (500 / 12) - 1) < 0.9
    correlation = np.corrcoef(draws[:-1].ravel(), draws[1:].ravel())[0, 1]
    assert abs(correlation) < 0.03


def test_large_and_negative_numbers_are_keys():
    ids = [2**63, 2**33, 0, -1, -(2**33)]
    values = {stream(1, number).random() for number in ids}
    assert len(values) == len(ids)
    assert stream(1, np.int64(5)).random() == stream(1, 5).random()


def test_text_key_is_the_head_of_the_sha256():
    expected = int(hashlib.sha256(b"abc").hexdigest()[:16], 16)
    assert text_key("abc") == expected


def test_seeds():
    assert check_seed(5) == 5
    assert check_seed(np.int32(5)) == 5
    assert check_seed(None) != check_seed(None)
    assert check_seed(np.random.default_rng(3)) == check_seed(np.random.default_rng(3))
    # what is drawn for None is a seed like any other
    seed = check_seed(None)
    assert stream(seed, "a").random() == stream(seed, "a").random()


@pytest.mark.parametrize("seed", [-1, 1.5, "3", True])
def test_refuses_what_is_no_seed(seed):
    refuses("'seed' must be a non-negative integer, a Generator or None", check_seed, seed)
