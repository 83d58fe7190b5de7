"""Streams of random numbers: the key decides, and nothing else."""

import hashlib

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from helpers.errors import refuses
from miricigale.utils.random import check_seed, stream, text_key


def test_same_key_same_stream():
    first = stream(1, "detector", "miri.f770w", 2).random(5)
    assert_array_equal(stream(1, "detector", "miri.f770w", 2).random(5), first)


@pytest.mark.parametrize(
    "key",
    [
        (2, "detector", "miri.f770w", 2),
        (1, "detector", "miri.f770w", 3),
        (1, "detector", "miri.f1000w", 2),
        (1, "scene", "miri.f770w", 2),
        (1, "detector", 2, "miri.f770w"),
        (1, "detector", "miri.f770w"),
    ],
)
def test_any_other_key_is_another_stream(key):
    first = stream(1, "detector", "miri.f770w", 2).random(5)
    assert not np.any(stream(*key).random(5) == first)


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


@pytest.mark.parametrize("seed", [-1, 1.5, "3", True])
def test_refuses_what_is_no_seed(seed):
    refuses("'seed' must be a non-negative integer, a Generator or None", check_seed, seed)


def test_seed_of_nothing_makes_streams():
    # what check_seed draws for None is a seed like any other
    seed = check_seed(None)
    assert stream(seed, "a").random() == stream(seed, "a").random()
