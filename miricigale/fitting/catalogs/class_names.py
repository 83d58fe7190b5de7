"""Which classes of sources are fitted besides galaxies."""

import logging

from miricigale.utils.options import check_names, check_that

log = logging.getLogger(__name__)

#: Names of the classes besides galaxies.
CLASSES = ("quasars", "red_dots", "stars")


def chosen_classes(classes=(), *, quasars=False, red_dots=False, stars=None):
    """
    Collect the classes that a caller asks for, by one argument or by one for each.

    Parameters
    ----------
    classes : iterable of str or str, optional
        Of `CLASSES`; as text with commas between them, or ``"all"``, which has stars only where there are spectra.
    quasars, red_dots : bool, optional
        Whether these are asked for.
    stars : path-like, optional
        Spectra of stars, which ask for stars.

    Returns
    -------
    names : set of str
        Of `CLASSES`.

    Raises
    ------
    KeyError
        If a class is unknown.
    ValueError
        If stars are asked for without spectra.
    """
    if isinstance(classes, str):
        requested = classes.replace("-", "_").split(",")
    else:
        requested = list(classes)
    names = {name.strip() for name in requested if name.strip()}
    all_classes = "all" in names
    names.discard("all")
    check_names(names, "class", CLASSES)
    if all_classes:
        names |= set(CLASSES)
        if stars is None:
            names.discard("stars")
            log.info("classes: no stars, for which there are no spectra ('stars', --stars)")
    if quasars:
        names.add("quasars")
    if red_dots:
        names.add("red_dots")
    if stars is not None:
        names.add("stars")
    if "stars" in names:
        wanted = "spectra (a file or folder; --stars) where stars are among the classes"
        check_that(stars is not None, "stars", wanted, "None")
    return names
