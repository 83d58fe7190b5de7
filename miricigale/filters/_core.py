"""Integrals over passbands: arrays only."""

import numpy as np

# Gauss-Legendre on each piece, where F and T are linear: the integrand is a quadratic over
# the wavelength, exact to rounding for the narrow pieces that `refine` leaves
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_NODES = 0.5 * (_NODES + 1)
_WEIGHTS = 0.5 * _WEIGHTS

_LARGEST_RATIO = 1.05

# relative width of the step to zero at the end of a curve that does not end in zero
_STEP = 1e-6


def padded(wave, throughput):
    """Trim zeros to one at each end, or add it."""
    inside = np.flatnonzero(throughput)
    first = max(inside[0] - 1, 0)
    last = min(inside[-1] + 1, wave.size - 1)
    wave = wave[first : last + 1]
    throughput = throughput[first : last + 1]
    if throughput[0] != 0:
        wave = np.concatenate([[wave[0] * (1 - _STEP)], wave])
        throughput = np.concatenate([[0.0], throughput])
    if throughput[-1] != 0:
        wave = np.concatenate([wave, [wave[-1] * (1 + _STEP)]])
        throughput = np.concatenate([throughput, [0.0]])
    return wave, throughput


def refine(wave, throughput):
    """Add nodes on the straight pieces of a curve until neighbors differ by 5 % in wavelength at most."""
    ratio = np.log(wave[1:] / wave[:-1]) / np.log(_LARGEST_RATIO)
    if ratio.max() <= 1:
        return wave, throughput
    parts = [
        np.geomspace(low, high, int(np.ceil(r)), endpoint=False) if r > 1 else np.array([low])
        for low, high, r in zip(wave[:-1], wave[1:], ratio, strict=True)
    ]
    fine = np.concatenate(list(parts) + [wave[-1:]])
    return fine, np.interp(fine, wave, throughput)


def photon_integral(wave, throughput, power=0):
    """Integral of ``throughput * wave**power / wave`` over a refined curve."""
    step = np.diff(wave)
    total = 0.0
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        lam = wave[:-1] + node * step
        t = throughput[:-1] + node * np.diff(throughput)
        total += weight * np.sum(step * t * lam ** (power - 1))
    return total


def band_weights(wave, band_wave, throughput, norm):
    """
    Weights of the values at ``wave`` in the photon-counting mean over a band.

    ``wave`` ascends, values between are linear in wavelength; ``band_wave`` and ``throughput`` are a
    refined passband, zero at both ends, ``norm`` its `photon_integral`. Returned are the index in
    ``wave`` of the first weight, and the weights: sum 1, or less by the share of the band that
    ``wave`` does not cover.
    """
    low = max(band_wave[0], wave[0])
    high = min(band_wave[-1], wave[-1])
    if not low < high:
        return 0, np.zeros(0)
    # indices of the values that can matter
    first = max(np.searchsorted(wave, low, side="right") - 1, 0)
    last = min(np.searchsorted(wave, high, side="left"), wave.size - 1)
    nodes = wave[first : last + 1]
    if band_wave[0] >= low and band_wave[-1] <= high:
        inside = band_wave
    else:
        inside = band_wave[(band_wave >= low) & (band_wave <= high)]
    edges = np.concatenate([inside, nodes[(nodes >= low) & (nodes <= high)]])
    edges.sort(kind="stable")
    low_edge = edges[:-1]
    step = np.diff(edges)
    values = np.interp(edges, band_wave, throughput)
    rise = np.diff(values)
    # the piece of the spectrum that each piece of the union lies on
    k = np.clip(np.searchsorted(nodes, low_edge + 0.5 * step, side="right") - 1, 0, nodes.size - 2)
    start = nodes[k]
    length = nodes[k + 1] - nodes[k]
    to_left = np.zeros(low_edge.size)
    to_right = np.zeros(low_edge.size)
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        lam = low_edge + node * step
        amount = weight * step * (values[:-1] + node * rise) / lam
        share = (lam - start) / length
        to_right += amount * share
        to_left += amount * (1 - share)
    size = nodes.size
    total = np.bincount(k, to_left, size) + np.bincount(k + 1, to_right, size)
    return int(first), total / norm
