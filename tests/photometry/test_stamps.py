"""Kernels of stamps against plain numpy: boxes of any place and size, some of them empty."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.interpolate import BSpline

from miricigale.photometry._core.sampling import sample_stamps
from miricigale.photometry._core.stamps import (
    cross_pairs,
    find_pairs,
    pair_products,
    projections,
    residual_statistics,
    scale_stamps,
    whiten_stamps,
)

SHAPE = (40, 50)


def boxes(n, seed):
    """Boxes (y0, x0, ny, nx) on the image, in order of their first row; every fifth is empty."""
    rng = np.random.default_rng(seed)
    size = rng.integers(1, 9, (n, 2)) * (np.arange(n)[:, None] % 5 > 0)
    box = np.hstack([rng.integers(0, np.subtract(SHAPE, 9), (n, 2)), size])
    return box[np.argsort(box[:, 0], kind="stable")].astype(np.int32)


def flat(box, seed):
    """Values of the pixels of boxes one after the other, and where each begins."""
    start = np.append(0, np.cumsum(box[:, 2] * box[:, 3]))
    return np.random.default_rng(seed).normal(size=start[-1]).astype(np.float32), start


def dense(box, values, start):
    """An image for each box, zero beside it."""
    out = np.zeros((len(box), *SHAPE))
    for image, (y, x, ny, nx), at in zip(out, box, start, strict=False):
        image[y : y + ny, x : x + nx] = values[at : at + ny * nx].reshape(ny, nx)
    return out


def covered(box, grow=0):
    y, x = np.indices(SHAPE)
    y0, x0, ny, nx = box.T[:, :, None, None]
    inside = (y >= y0 - grow) & (y < y0 + ny + grow) & (x >= x0 - grow) & (x < x0 + nx + grow)
    return (inside & (ny > 0)).reshape(len(box), -1).astype(int)


@pytest.mark.parametrize("grow", [0, 2])
def test_pairs_of_boxes_are_those_that_share_pixels(grow):
    box, other = boxes(40, 1), boxes(30, 2)
    wanted = np.argwhere(np.triu(covered(box, grow) @ covered(box).T, 1))
    assert_array_equal(sorted(map(tuple, find_pairs(box, grow))), wanted)
    found = sorted(map(tuple, cross_pairs(box, other)))
    assert_array_equal(found, np.argwhere(covered(box) @ covered(other).T))


def test_sums_over_stamps_are_those_over_images():
    box, other = boxes(40, 1), boxes(30, 2)
    (a, a_start), (b, b_start) = flat(box, 3), flat(other, 4)
    pairs, one, two = cross_pairs(box, other), dense(box, a, a_start), dense(other, b, b_start)
    out = np.empty(len(pairs))
    pair_products(a, box, a_start, b, other, b_start, pairs, out)
    assert_allclose(out, np.einsum("kij,kij->k", one[pairs[:, 0]], two[pairs[:, 1]]), atol=1e-12)
    noise = np.random.default_rng(5).uniform(0.5, 2.0, SHAPE).astype(np.float32)
    noise[10:20, 15:30] = 0
    out = np.empty(len(box))
    projections(a, box, a_start, noise, out)
    assert_allclose(out, np.sum(one * noise, axis=(1, 2)), rtol=1e-12, atol=1e-12)
    white, sums = np.empty_like(a), np.empty((len(box), 4))
    whiten_stamps(a, box, a_start, noise, white, sums)
    found = dense(box, white, a_start)
    assert_allclose(found, one * noise, rtol=1e-6)
    parts = one, one * (noise > 0), one**2, found**2
    assert_allclose(sums, np.transpose([np.sum(p, axis=(1, 2)) for p in parts]), rtol=1e-12)


def test_statistics_of_stamps_are_sums_of_images_over_their_cores():
    box = boxes(30, 6)
    values, start = flat(box, 7)
    rng = np.random.default_rng(8)
    residual, light = rng.normal(size=(2, *SHAPE)).astype(np.float32)
    inverse_sigma = rng.uniform(0.5, 2.0, SHAPE).astype(np.float32)
    inverse_sigma[rng.random(SHAPE) < 0.2] = 0.0
    sums = np.empty((len(box), 4))
    residual_statistics(values, box, start, residual, light, inverse_sigma, sums)
    for row, template in zip(sums, dense(box, values, start), strict=True):
        usable = (template > 0) & (inverse_sigma > 0)
        core = usable & (template > 0.1 * template.max())
        wanted = [residual[core].sum(), light[core].sum(), template[core].sum()]
        assert_allclose(row[1:], wanted, rtol=1e-5, atol=1e-5)
        if usable.any():
            chi2 = (residual * inverse_sigma)[usable] ** 2
            assert_allclose(row[0], np.average(chi2, weights=template[usable]), rtol=1e-5)
        else:
            assert np.isnan(row[0])


def test_sampled_stamps_are_splines_times_the_area_of_the_pixel():
    """Quintic B-splines of scipy at quadratics of the place; nodes beyond the rim are zero."""
    rng, spline = np.random.default_rng(6), BSpline.basis_element(np.arange(-3.0, 4.0))
    coefficients = rng.normal(size=(2, 14, 16))
    which, amplitude = np.array([1, 0, 1]), np.array([2.0, 0.0, -0.7])
    box = np.array([[3, 4, 9, 11], [5, 5, 4, 4], [20, 30, 12, 7]])
    center = box[:, [1, 0]] + rng.uniform(3, 5, (3, 2))
    poly = rng.normal(0, 0.02, (3, 2, 6))
    poly[:, 0, :3] += 8.0, 1.9, 0.3
    poly[:, 1, :3] += 7.0, -0.2, 1.7
    start = np.append(0, np.cumsum(box[:, 2] * box[:, 3]))
    out = np.ones(start[-1])
    sample_stamps(coefficients, which, amplitude, center, poly, box, start, out)
    for k, (y0, x0, ny, nx) in enumerate(box):
        v, u = np.mgrid[y0 : y0 + ny, x0 : x0 + nx] - center[k, ::-1, None, None]
        place = [p @ [one.ravel() for one in (u**0, u, v, u * u, u * v, v * v)] for p in poly[k]]
        weights = [
            np.where(abs(apart) < 3, spline(apart), 0.0)
            for apart in (x[:, None] - np.arange(n) for x, n in zip(place, (16, 14), strict=True))
        ]
        (xu, xv), (yu, yv) = ((p[1] + 2 * p[3] * u + p[4] * v, p[2] + p[4] * u + 2 * p[5] * v)
                              for p in poly[k])  # fmt: skip
        value = np.einsum("ni,nj,ji->n", *weights, coefficients[which[k]])
        wanted = 1 + amplitude[k] * value * np.abs(xu * yv - xv * yu).ravel()
        assert_allclose(out[start[k] : start[k + 1]], wanted, rtol=1e-10, atol=1e-12)


def test_grids_along_each_other_are_sampled_as_grids_that_are_turned():
    """A turn too small to be seen takes the general way; stamps reach beyond the coefficients."""
    rng = np.random.default_rng(1)
    coefficients = rng.normal(size=(2, 31, 37)).astype(np.float32)
    box = np.array([[98, 97, 40, 44], [105, 108, 9, 12]])
    start = np.array([0, 40 * 44, 40 * 44 + 9 * 12])
    center = np.array([[118.2, 117.7], [112.4, 110.0]])
    poly = np.zeros((2, 2, 6))
    poly[:, 0, :2] = [[17.3, 0.9], [18.0, 1.0]]
    poly[:, 1, 0] = 15.6
    poly[:, 1, 2] = [1.1, 1.0]
    # a slope of the scale is no turn
    poly[:, 0, 3] = poly[:, 1, 5] = 1e-3
    which, amplitude = np.array([1, 0]), np.array([2.0, 0.5])
    stamps = []
    for turn in (0.0, 1e-9, 1e-7):
        poly[:, 0, 2] = turn
        out = np.zeros(start[-1])
        sample_stamps(coefficients, which, amplitude, center, poly, box, start, out)
        stamps.append(out)
    straight, nearly, turned = stamps
    assert np.count_nonzero(straight[: start[1]]) < start[1]
    assert_allclose(nearly, straight, atol=1e-6)
    assert_allclose(turned, straight, atol=1e-4)


def test_scaled_stamps_are_zero_beyond_the_image():
    box = boxes(40, 8)
    # as those that are spread: beyond the image on all sides
    box = box + np.array([-6, -6, 12, 12], np.int32)
    values, start = flat(box, 9)
    image = np.random.default_rng(10).random(SHAPE).astype(np.float32)
    expected = values.copy()
    wide = np.pad(image, 10)
    for (y, x, ny, nx), first in zip(box, start, strict=False):
        part = wide[y + 10 : y + 10 + ny, x + 10 : x + 10 + nx]
        expected[first : first + ny * nx] *= part.ravel()
    assert box[:, :2].min() < 0
    scale_stamps(values, box, start, image)
    assert_array_equal(values, expected)
