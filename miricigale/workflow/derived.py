"""
Derived runs: the same study with one setting changed, and its comparison with the study.

The stages ``variants``, ``rivals`` and ``experiments`` and the perturbed truths each say what they change
and compute the numbers that are compared; ``page/sections.toml`` declares what the page says of them.
"""

import dataclasses
import types

import numpy as np

#: Why a number of a comparison is missing.
NO_SOURCE = "no such source"


def changed_config(config, sections, changes):
    """
    Return sections of a configuration with other values.

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration, or the part of it that a stage declares.
    sections : iterable of str
        Names of the sections that are needed.
    changes : dict of str to dict
        Values by section and key.

    Returns
    -------
    changed : `~types.SimpleNamespace`
        With the sections as attributes.
    """
    changed = types.SimpleNamespace()
    for name in sections:
        section = dataclasses.replace(getattr(config, name), **changes.get(name, {}))
        setattr(changed, name, section)
    return changed


def rows_of(table, ids):
    """Return the rows of a table with the given ids, in their order."""
    place = {key: row for row, key in enumerate(np.asarray(table["id"]))}
    return table[[place[key] for key in np.asarray(ids)]]
