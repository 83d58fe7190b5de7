"""Many models at once: starlight behind dust with its re-emission, and fluxes in bands."""

import numpy as np

from miricigale.sed._core.bands import band_means
from miricigale.utils.compilation import njit

_TILE = 512  # wavelengths, and
_ROWS = 16  # rows, whose sums stay in the cache


@njit()
def weighted_sums(weights, spectra):
    """
    Sums of spectra, shape (n_age, n_wave), with the weights of each row: shape (n, n_wave).

    The digits of a row do not depend on the others, as those of a matrix product do, and ages
    without weight cost nothing.
    """
    n_age, n_wave = spectra.shape
    n = weights.shape[0]
    out = np.zeros((n, n_wave))
    has_weight = np.empty(n_age, dtype=np.bool_)
    for head in range(0, n, _ROWS):
        rows = range(head, min(head + _ROWS, n))
        for k in range(n_age):
            has_weight[k] = False
            for i in rows:
                if weights[i, k] != 0.0:
                    has_weight[k] = True
        weighted = np.flatnonzero(has_weight)
        four = weighted.size - weighted.size % 4
        for first in range(0, n_wave, _TILE):
            last = min(first + _TILE, n_wave)
            for k in range(0, four, 4):  # added one after the other, whatever their number
                a = weighted[k]
                b = weighted[k + 1]
                c = weighted[k + 2]
                d = weighted[k + 3]
                p = spectra[a, first:last]
                q = spectra[b, first:last]
                r = spectra[c, first:last]
                s = spectra[d, first:last]
                for i in rows:
                    w = weights[i, a]
                    x = weights[i, b]
                    y = weights[i, c]
                    z = weights[i, d]
                    if w == 0.0 and x == 0.0 and y == 0.0 and z == 0.0:
                        continue
                    total = out[i, first:last]
                    for j in range(last - first):
                        total[j] = (((total[j] + w * p[j]) + x * q[j]) + y * r[j]) + z * s[j]
            for k in range(four, weighted.size):
                p = spectra[weighted[k], first:last]
                for i in rows:
                    w = weights[i, weighted[k]]
                    total = out[i, first:last]
                    for j in range(last - first):
                        total[j] += w * p[j]
    return out


@njit()
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


@njit()
def block_fluxes(
    wave, inverse_step, to_lnu, light, agn, model_of_row, power, dim, sky, z, scale,
    span, edge, integrals, tolerance, out,
):  # fmt: skip
    """
    Band fluxes of a block of models, each at its own redshift.

    Parameters
    ----------
    wave, to_lnu : shape (n_wave,)
        Rest wavelengths in um, and the factor from L_lambda to L_nu.
    inverse_step : shape (n_wave - 1,)
        One over the steps between wavelengths.
    light, agn : shape (n, n_wave) and (n_agn, n_wave)
        L_lambda of the galaxies, and of AGN for one watt.
    model_of_row, power : shape (n,)
        Which of the AGN each model has (int), and its power in W.
    dim, sky : shape (n_dim, n_wave) and (n,)
        Transmissions between the source and us, and which of them each model has (int).
    z, scale : shape (n,)
        Redshift, and factor from L_nu to flux.
    span, edge, integrals, tolerance
        As for `band_means`.
    out : shape (n, n_band)
        Filled with the fluxes; NaN in bands that the spectrum does not cover.
    """
    observed = np.empty(wave.size)
    fnu = np.empty(wave.size)
    slope = np.zeros(wave.size)
    turn = np.zeros(wave.size)
    low = span[:, 0].min()
    high = span[:, 1].max()
    for i in range(z.size):
        k = model_of_row[i]
        p = power[i]
        s = sky[i]
        stretch = 1.0 + z[i]
        per_step = 1.0 / stretch
        for j in range(wave.size):
            observed[j] = wave[j] * stretch
        # what no band looks at is left out
        begin = max(np.searchsorted(observed, low, side="right") - 1, 0)
        end = min(np.searchsorted(observed, high) + 1, wave.size)
        for j in range(begin, end):
            fnu[j] = light[i, j] * to_lnu[j] * dim[s, j]
        if p > 0.0:
            for j in range(begin, end):
                fnu[j] += p * agn[k, j] * to_lnu[j] * dim[s, j]
        for j in range(begin, end - 1):
            slope[j] = (fnu[j + 1] - fnu[j]) * inverse_step[j] * per_step
        for j in range(begin + 1, end - 1):
            turn[j] = slope[j] - slope[j - 1]
        band_means(observed, fnu, slope, turn, span, edge, integrals, tolerance, out[i])
        for b in range(out.shape[1]):
            out[i, b] *= scale[i]
