"""CIGALE's names of physical quantities, for ours."""

import astropy.units as u

#: Parts of an AGN's light, by their names in `~miricigale.sed.components.AGNTemplates`: our name of the
#: luminosity, which models do not have by themselves, and CIGALE's.
AGN_PARTS = {
    "disk": ("disk_luminosity", "agn.disk_luminosity"),
    "torus": ("torus_luminosity", "agn.torus_dust_luminosity"),
    "polar": ("polar_luminosity", "agn.polar_dust_luminosity"),
}
# our name, CIGALE's, CIGALE's unit
_PARAMETERS = (
    ("redshift", "universe.redshift", ""),
    ("tau97", "agn.t", ""),
    ("p", "agn.pl", ""),
    ("q", "agn.q", ""),
    ("opening_angle", "agn.oa", "deg"),
    ("radius_ratio", "agn.R", ""),
    ("inclination", "agn.i", "deg"),
    ("disk_slope", "agn.delta", ""),
    ("frac_agn", "agn.fracAGN", ""),
    ("ebv_polar", "agn.EBV", "mag"),
    ("temperature_polar", "agn.temperature", "K"),
    ("emissivity_polar", "agn.emissivity", ""),
    ("alpha", "dust.alpha", ""),
    ("temperature_dust", "dust.temperature", "K"),
    ("emissivity_dust", "dust.beta", ""),
    ("alpha_mir", "dust.alpha", ""),
    ("u_min", "dust.umin", ""),
    ("q_pah", "dust.qpah", ""),
    ("gamma", "dust.gamma", ""),
    ("tau", "sfh.tau_main", "Myr"),
    ("age", "sfh.age_main", "Myr"),
    ("f_burst", "sfh.f_burst", ""),
    ("age_burst", "sfh.age_burst", "Myr"),
    ("tau_burst", "sfh.tau_burst", "Myr"),
    ("metallicity", "stellar.metallicity", ""),
    ("separation_age", "stellar.old_young_separation_age", "Myr"),
    ("log_u", "nebular.logU", ""),
    ("metallicity_gas", "nebular.zgas", ""),
    ("f_esc", "nebular.f_esc", ""),
    ("f_dust", "nebular.f_dust", ""),
    ("ebv", "attenuation.E_BVs.stellar.young", "mag"),
    ("ebv_lines", "attenuation.E_BV_lines", "mag"),
    ("ebv_factor_stars", "attenuation.E_BV_factor", ""),
    ("ebv_factor", "attenuation.ebvs_old_factor", ""),
    ("slope", "attenuation.powerlaw_slope", ""),
    ("uv_bump", "attenuation.uv_bump_amplitude", ""),
    ("uv_bump_wavelength", "attenuation.uv_bump_wavelength", "nm"),
    ("uv_bump_width", "attenuation.uv_bump_width", "nm"),
    ("av_ism", "attenuation.Av_ISM", "mag"),
    ("mu", "attenuation.mu", ""),
    ("slope_ism", "attenuation.slope_ISM", ""),
    ("slope_bc", "attenuation.slope_BC", ""),
    ("stellar_mass", "stellar.m_star", "solMass"),
    ("mass", "sfh.integrated", "solMass"),
    ("sfr", "sfh.sfr", "solMass / yr"),
    ("sfr_10myr", "sfh.sfr10Myrs", "solMass / yr"),
    ("sfr_100myr", "sfh.sfr100Myrs", "solMass / yr"),
    ("dust_luminosity", "dust.luminosity", "W"),
    ("agn_power", "agn.total_dust_luminosity", "W"),
    ("agn_luminosity", "agn.luminosity", "W"),
    ("accretion_power", "agn.accretion_power", "W"),
    ("l_6um", "agn.L_6um", "W"),
    ("alpha_ox", "xray.alpha_ox", ""),
    ("l_2500", "agn.intrin_Lnu_2500A_30deg", "W / Hz"),
    ("l_2_10kev", "xray.agn_Lx_2to10keV", "W"),
    ("beta", "param.beta_calz94", ""),
    *((ours, theirs, "W") for ours, theirs in AGN_PARTS.values()),
)
#: Our units where they are not CIGALE's.
_OURS = {
    **dict.fromkeys(("tau", "age", "age_burst", "tau_burst"), u.Gyr),
    **dict.fromkeys(("uv_bump_wavelength", "uv_bump_width"), u.um),
}
#: Names that depend on the module.
_OF_MODULE = {
    "sfh2exp": {"age": "sfh.age", "age_burst": "sfh.burst_age"},
    "sfhfromfile": {"age": "sfh.age"},
}


def cigale_names(modules=None):
    """
    CIGALE's names of what we have: our name to CIGALE's, its unit, and the factor to it from ours.

    ``modules`` is the role of a component to CIGALE's module, on which some names depend.
    """
    names = {}
    for ours, theirs, unit in _PARAMETERS:
        unit = u.Unit(unit)
        names[ours] = (theirs, unit, _OURS.get(ours, unit).to(unit))
    for module in (modules or {}).values():
        for ours, theirs in _OF_MODULE.get(module, {}).items():
            names[ours] = (theirs, *names[ours][1:])
    return names


def unit_of(name):
    """Unit of a quantity of CIGALE's name; None if it is not known."""
    every = (cigale_names({"": module}).values() for module in ("", *_OF_MODULE))
    return next((unit for names in every for theirs, unit, _ in names if theirs == name), None)
