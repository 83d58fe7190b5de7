"""Arithmetic of spectra: arrays in, arrays out (um, W/um, Myr unless said)."""

from miricigale.sed._core.attenuation import (
    attenuation_curve,
    leitherer_calzetti,
    pei_extinction,
    power_law_attenuation,
    smc_power_law,
)
from miricigale.sed._core.bands import band_means, band_tables
from miricigale.sed._core.batched_models import block_fluxes, mix_light, weighted_sums
from miricigale.sed._core.disk import DISK_BREAKS, DISKS, disk_nodes, disk_spectrum
from miricigale.sed._core.histories import (
    YOUNG,
    age_steps,
    delayed_history,
    double_exponential_history,
    split_by_age,
    table_history,
    time_weights,
)
from miricigale.sed._core.igm import (
    INOUE_LIMIT,
    LYMAN_LIMIT,
    inoue_lines,
    inoue_transmission,
    lyman_lines,
    madau_transmission,
    meiksin_transmission,
)
from miricigale.sed._core.nebular import absorbed_share, line_operator, photons_by_age
from miricigale.sed._core.nodes import (
    cells,
    hat_matrix,
    merge_nodes,
    photon_weights,
    trapezoid_weights,
    wave_key,
)
from miricigale.sed._core.polar import (
    DISK_MEAN,
    POLAR_LAWS,
    add_polar,
    polar_curve,
    polar_grid,
    polar_share,
)
from miricigale.sed._core.thermal import PLANCK_K, drude, modified_blackbody, planck_lambda
from miricigale.sed._core.xray import power_law_energy, stern2015, stern2015_6um, xray_flux

LIGHT = 2.99792458e14  # um / s
