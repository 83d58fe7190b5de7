"""Arithmetic of spectra: arrays in, arrays out (um, W/um, Myr unless said)."""

from miricigale.sed._core.attenuation import attenuation_curve, leitherer_calzetti
from miricigale.sed._core.bands import band_means, band_moments
from miricigale.sed._core.disk import DISK_BREAKS, DISK_SLOPES, disk_spectrum
from miricigale.sed._core.histories import YOUNG, delayed_history, time_weights
from miricigale.sed._core.igm import (
    LYMAN_LIMIT,
    lyman_lines,
    madau_transmission,
    meiksin_transmission,
)
from miricigale.sed._core.nodes import hat_matrix, merge_nodes
from miricigale.sed._core.thermal import PLANCK_K, drude, modified_blackbody, planck_lambda

LIGHT = 2.99792458e14  # um / s

__all__ = [
    "DISK_BREAKS",
    "DISK_SLOPES",
    "LIGHT",
    "LYMAN_LIMIT",
    "PLANCK_K",
    "YOUNG",
    "attenuation_curve",
    "band_means",
    "band_moments",
    "delayed_history",
    "disk_spectrum",
    "drude",
    "hat_matrix",
    "leitherer_calzetti",
    "lyman_lines",
    "madau_transmission",
    "meiksin_transmission",
    "merge_nodes",
    "modified_blackbody",
    "planck_lambda",
    "time_weights",
]
