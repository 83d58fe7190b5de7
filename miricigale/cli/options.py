"""What the options of several commands are made of."""

import argparse

__all__ = ["GOES_ON", "chosen", "pair", "quantity_in"]

#: Message of an interrupted command that resumes where it stopped.
GOES_ON = "stopped; the same command goes on from here"


def quantity_in(unit):
    """Type of an option that is a number in a unit."""

    def number(text):
        import astropy.units as u

        return float(text) * u.Unit(unit)

    return number


def chosen(args, names):
    """Options by the names of the arguments that they become."""
    return {name: getattr(args, name) for name in names.split()}


def pair(text):
    """Two names with a colon between them."""
    names = tuple(text.split(":"))
    if len(names) != 2 or not all(names):
        msg = f"{text!r} is no pair NAME:NAME"
        raise argparse.ArgumentTypeError(msg)
    return names
