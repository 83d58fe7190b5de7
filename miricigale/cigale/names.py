"""CIGALE's names of physical quantities, for ours."""

import astropy.units as u

from miricigale.utils.package_tables import declared

#: What ``names.toml`` has.
DECLARED = declared("miricigale.cigale", "names.toml")
#: Parts of an AGN's light, by their names in `~miricigale.sed.components.AGNTemplates`: our name of the
#: luminosity, which models do not have by themselves, and CIGALE's.
AGN_PARTS = {
    part: (f"{part}_luminosity", DECLARED["quantities"][f"{part}_luminosity"][0])
    for part in ("disk", "torus", "polar")
}


def cigale_names(modules):
    """
    Return CIGALE's names of what we have: our name to CIGALE's, its unit, and the factor to it from ours.

    ``modules`` is the role of a component to CIGALE's module, on which some names depend.
    """
    names = {}
    for ours, (theirs, unit) in DECLARED["quantities"].items():
        our_unit = u.Unit(DECLARED["units"].get(ours, unit))
        names[ours] = (theirs, u.Unit(unit), our_unit.to(unit))
    for module in (modules or {}).values():
        for ours, theirs in DECLARED["modules"].get(module, {}).items():
            _, unit, factor = names[ours]
            names[ours] = (theirs, unit, factor)
    return names


def unit_of(name):
    """Return the unit of a quantity of CIGALE's name; None if it is not known."""
    for module in ["", *DECLARED["modules"]]:
        for theirs, unit, _ in cigale_names({"": module}).values():
            if theirs == name:
                return unit
    return None
