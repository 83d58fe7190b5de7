"""Many models at once: starlight behind dust with its re-emission, and fluxes in bands."""

import math

import numpy as np

from miricigale.sed._core.bands import band_means
from miricigale.utils.compilation import njit

_TILE = 256  # wavelengths of all ages that stay in the cache


@njit(cache=True)
def weighted_sums(weights, spectra):
    """
    Sums of spectra, shape (n_age, n_wave), with the weights of each row: shape (n, n_wave).

    The digits of a row do not depend on the others, as those of a matrix product do, and ages
    without weight cost nothing.
    """
    n_wave = spectra.shape[1]
    out = np.zeros((weights.shape[0], n_wave))
    for first in range(0, n_wave, _TILE):
        last = min(first + _TILE, n_wave)
        for i in range(weights.shape[0]):
            total = out[i, first:last]
            used = np.flatnonzero(weights[i])
            four = used.size - used.size % 4
            for k in range(0, four, 4):  # added one after the other, whatever their number
                a = used[k]
                b = used[k + 1]
                c = used[k + 2]
                d = used[k + 3]
                w = weights[i, a]
                x = weights[i, b]
                y = weights[i, c]
                z = weights[i, d]
                p = spectra[a, first:last]
                q = spectra[b, first:last]
                r = spectra[c, first:last]
                s = spectra[d, first:last]
                for j in range(last - first):
                    total[j] = (((total[j] + w * p[j]) + x * q[j]) + y * r[j]) + z * s[j]
            for k in range(four, used.size):
                w = weights[i, used[k]]
                p = spectra[used[k], first:last]
                for j in range(last - first):
                    total[j] += w * p[j]
    return out


@njit(cache=True)
def mix_light(
    weight,
    young,
    old,
    gas,
    star,
    dim_young,
    dim_old,
    dim_gas,
    dim,
    extra,
    dust,
    dusty,
    out,
    absorbed,
):
    """
    Galaxies of one solar mass: attenuated starlight plus the dust that it heats.

    Parameters
    ----------
    weight : shape (n_wave,)
        Weights of the trapezoid rule.
    young, old : shape (n_star, n_wave)
        Light of young and old stars in W/um, with that of their gas if it is dimmed as they are.
    gas : shape (n_star, n_wave) or (0, n_wave)
        Light of gas that has a transmission of its own.
    star, dim, dusty : int, shape (n,)
        Which stars, attenuation and dust spectrum each galaxy has.
    dim_young, dim_old, dim_gas : shape (n_dim, n_wave)
        Transmissions for young and old stars and for ``gas``.
    extra : shape (n_star,)
        Power in W that dust takes besides.
    dust : shape (n_dust, n_wave)
        Dust spectra in W/um with integral 1.
    out, taken : shape (n, n_wave) and (n,)
        Filled with the light in W/um and the power in W that dust took.
    """
    own_gas = gas.shape[0] > 0
    for i in range(star.size):
        s = star[i]
        a = dim[i]
        d = dusty[i]
        lost = 0.0
        for j in range(weight.size):
            light = young[s, j] * dim_young[a, j] + old[s, j] * dim_old[a, j]
            before = young[s, j] + old[s, j]
            if own_gas:
                light += gas[s, j] * dim_gas[a, j]
                before += gas[s, j]
            lost += weight[j] * (before - light)
            out[i, j] = light
        lost += extra[s]
        absorbed[i] = lost
        for j in range(weight.size):
            out[i, j] += lost * dust[d, j]


@njit(cache=True)
def block_fluxes(
    wave, log_wave, to_lnu, light, agn, model_of_row, power, dim, sky, z, scale,
    start, band, moments, bucket, tolerance, out,
):  # fmt: skip
    """
    Band fluxes of a block of models, each at its own redshift.

    Parameters
    ----------
    wave, log_wave, to_lnu : shape (n_wave,)
        Rest wavelengths in um, their logarithms, and the factor from L_lambda to L_nu.
    light, agn : shape (n, n_wave) and (n_agn, n_wave)
        L_lambda of the galaxies, and of AGN for one watt.
    which, power : shape (n,)
        Which of the AGN each model has (int), and its power in W.
    dim, sky : shape (n_dim, n_wave) and (n,)
        Transmissions between the source and us, and which of them each model has (int).
    z, scale : shape (n,)
        Redshift, and factor from L_nu to flux.
    start, band, moments, bucket, tolerance
        As for `band_means`.
    out : shape (n, n_band)
        Filled with the fluxes; NaN in bands that the spectrum does not cover.
    """
    observed = np.empty(wave.size)
    log_observed = np.empty(wave.size)
    fnu = np.empty(wave.size)
    low = band.min()
    high = band.max()
    for i in range(z.size):
        k = model_of_row[i]
        p = power[i]
        s = sky[i]
        stretch = 1.0 + z[i]
        log_stretch = math.log(stretch)
        for j in range(wave.size):
            observed[j] = wave[j] * stretch
        # what no band looks at is left out
        begin = max(np.searchsorted(observed, low, side="right") - 1, 0)
        for j in range(begin, min(np.searchsorted(observed, high) + 1, wave.size)):
            log_observed[j] = log_wave[j] + log_stretch
            total = light[i, j]
            if p > 0.0:
                total += p * agn[k, j]
            fnu[j] = total * to_lnu[j] * dim[s, j]
        band_means(observed, log_observed, fnu, start, band, moments, bucket, tolerance, out[i])
        for b in range(out.shape[1]):
            out[i, b] *= scale[i]
