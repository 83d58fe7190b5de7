"""Keys that configurations of earlier versions have, and what became of them."""

import dataclasses

from miricigale.utils.exceptions import ConfigError, MiricigaleWarning, warn


@dataclasses.dataclass(frozen=True)
class EarlierKey:
    """
    What became of a key of an earlier version.

    Parameters
    ----------
    name : str, optional
        What it is called today, ``section.key``; empty for a key that is gone.
    without_effect : tuple, optional
        Values of a key that is gone that ask for nothing: they are left out. None for all values.
    instead : str, optional
        What to do in place of its other values.
    """

    name: str = ""
    without_effect: tuple | None = None
    instead: str = ""


def keys_of_today(values, earlier):
    """
    Put the keys of an earlier version under the names of today.

    Parameters
    ----------
    values : dict of dict
        Sections and their keys, as a file has them.
    earlier : dict of str to `EarlierKey`
        By ``section.key``.

    Returns
    -------
    values : dict of dict
        A copy; what was renamed or left out is warned of.

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If a key is there under both names, or is gone and asks for something. The message has all of them.
    """
    sections = {}
    for name, entries in values.items():
        if isinstance(entries, dict):
            sections[name] = dict(entries)
        else:
            sections[name] = entries
    renamed = []
    gone = []
    refused = []
    for old, entry in earlier.items():
        section, _, key = old.partition(".")
        entries = sections.get(section)
        if not isinstance(entries, dict) or key not in entries:
            continue
        value = entries.pop(key)
        if entry.name:
            today, _, name = entry.name.partition(".")
            target = sections.setdefault(today, {})
            if not isinstance(target, dict) or name in target:
                refused.append(
                    f"[{section}] {key} is called [{today}] {name} now, and both are there: remove {key}"
                )
            else:
                target[name] = value
                renamed.append(f"[{section}] {key} is called [{today}] {name} now")
        elif entry.without_effect is None or value in entry.without_effect:
            gone.append(f"[{section}] {key}")
        else:
            refused.append(f"[{section}] {key} = {value!r} is gone: {entry.instead}")
    if refused:
        raise ConfigError("; ".join(refused))
    if gone:
        renamed.append(f"{', '.join(gone)}, without effect, left out")
    if renamed:
        warn(f"a configuration of an earlier version: {'; '.join(renamed)}", MiricigaleWarning)
    # sections that held nothing else
    for key in earlier:
        section = key.partition(".")[0]
        if sections.get(section) == {}:
            del sections[section]
    return sections
