"""The parser of the program, from the declarations of ``commands.toml``."""

import argparse
import contextlib
import difflib
import inspect
import re
import sys
import tomllib
from importlib import resources
from pathlib import Path


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one sentence."""

    def error(self, message):
        """Say what is wrong with the arguments, the nearest name that there is, and end with status 2."""
        choice = re.search(r"invalid choice: '?(.+?)'? \(choose from (.+)\)", message)
        unknown = re.match(r"unrecognized arguments: (\S+)", message)
        hint = ""
        if choice:
            hint = _nearest(choice[1], [name.strip(" '") for name in choice[2].split(",")])
        elif unknown:
            hint = _nearest(unknown[1].partition("=")[0], self.every_flag)
        self.exit(2, f"{self.prog}: {message}{hint} (see {self.prog} --help)\n")

    #: Flags of all commands, for the nearest one to a wrong one.
    every_flag = ()


def _nearest(name, known):
    """Say which name may be meant; empty if none is near."""
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else ""


def quantity_in(unit):
    """Type of an option that is a number in a unit."""

    def number(text):
        import astropy.units as u

        return float(text) * u.Unit(unit)

    return number


def pair(text):
    """Two names with a colon between them."""
    names = tuple(text.split(":"))
    if len(names) != 2 or not all(names):
        msg = f"{text!r} is no pair NAME:NAME"
        raise argparse.ArgumentTypeError(msg)
    return names


#: Types of options by their names in the declarations.
TYPES = {
    "int": int,
    "float": float,
    "path": Path,
    "pair": pair,
    "arcsec": quantity_in("arcsec"),
    "deg": quantity_in("deg"),
}


def chosen(args, names):
    """Options by the names of the arguments that they become."""
    return {name: getattr(args, name) for name in names.split()}


def filled(args, function):
    """Return the options that are named like parameters of a function, or like fields of settings."""
    names = inspect.signature(function).parameters
    return {name: value for name, value in vars(args).items() if name in names}


def declarations():
    """What ``commands.toml`` declares: of each command by name, and of ``shared`` options."""
    return tomllib.loads((resources.files("miricigale.cli") / "commands.toml").read_text("utf-8"))


@contextlib.contextmanager
def workers(scheduler, n_threads, memory=None):
    """Processes of this machine, or the workers of a dask scheduler, as an executor of a run that is resumed."""
    from miricigale.utils.exceptions import OtherResultsError
    from miricigale.utils.parallel import process_pool, thread_count
    from miricigale.workflow.engine.cluster import cluster_executor

    if scheduler is None:
        pool = process_pool(thread_count(n_threads or None))
    else:
        pool = cluster_executor(scheduler, memory=memory)
    try:
        with pool as executor:
            yield executor
    except OtherResultsError as err:
        # name the option of the command instead of the argument
        raise OtherResultsError(err.reason, "--redo to replace it") from err


def make_parser(argv):
    """The parser of the program; help texts are complete where they are asked for."""
    known = {}
    if not argv or {"-h", "--help"} & set(argv):
        from miricigale.filters.surveys import SURVEYS
        from miricigale.workflow.config import preset_names

        known = {"{presets}": ", ".join(preset_names()), "{surveys}": ", ".join(SURVEYS)}
    declared = declarations()
    shared = declared.pop("shared")
    talk = argparse.ArgumentParser(add_help=False, argument_default=argparse.SUPPRESS)
    how = talk.add_mutually_exclusive_group()
    how.add_argument("-v", "--verbose", action="store_true", help="say what is done")
    how.add_argument("-q", "--quiet", action="store_true", help="errors and warnings only")
    about = "Plan and analyze JWST/MIRI deep imaging."
    parser = Parser(prog="miricigale", description=about, parents=[talk])
    parser.add_argument("--version", action="store_true", help="print the version and stop")
    parsers = {"": parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)}
    for name, command in declared.items():
        group, _, last = name.rpartition(" ")
        text = _filled(command["help"], known)
        made = parsers[group].add_parser(
            last,
            help=text,
            description=command.get("description", f"{text[0].upper()}{text[1:]}."),
            epilog="examples:\n  " + "\n  ".join(command["examples"]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            parents=[talk],
        )
        if "call" not in command:
            parsers[name] = made.add_subparsers(dest="action", metavar="ACTION", required=True)
            continue
        stopped = command.get("stopped", "miricigale: stopped")
        made.set_defaults(call=command["call"], stopped=stopped)
        options = command.get("options", {})
        for other, flags in command.get("as_in", {}).items():
            options |= {one: declared[other]["options"][one] for one in flags}
        options |= {shared[one]["flags"]: shared[one] for one in command.get("shared", ())}
        groups, section, title = {}, made, None
        for flags, option in _of_both(options):
            # an option of image and prior has its heading twice
            if option.get("heading", title) != title:
                title = option["heading"]
                section = made.add_argument_group(title)
            is_positional = not flags.startswith("-")
            _add(made if is_positional else section, groups, flags, option, known)
        names = _option_names(made)
        made.set_defaults(option_names=names)
        parser.every_flag = (*parser.every_flag, *names.values())
    return parser


def _option_names(parser):
    """What a user types for each argument of a command: its longest flag, or what a positional one is called."""
    names = {}
    for action in parser._actions:
        if action.option_strings:
            names.setdefault(action.dest, max(action.option_strings, key=len))
        else:
            names[action.dest] = action.metavar or action.dest
    return names


def in_options(message, names):
    """
    Put options in place of the names of Python's arguments in a message.

    Parameters
    ----------
    message : str
        Such as ``"'chunk_rows' must be an integer >= 1, got 0"``.
    names : dict of str to str
        What a user types for each argument, such as ``"--chunk-rows"``.

    Returns
    -------
    message : str

    Examples
    --------
    >>> from miricigale.cli.options import in_options
    >>> in_options("'chunk_rows' must be >= 1", {"chunk_rows": "--chunk-rows"})
    '--chunk-rows must be >= 1'
    """
    return re.sub(
        r"'(\w+)'(?= must | is | column '| given\))",
        lambda match: names.get(match[1], match[0]),
        message,
    )


def _of_both(options):
    """Options with those of the image and of the prior apart."""
    for flags, option in options.items():
        both = (("", "image"), ("highres-", "prior")) if "{prefix}" in flags else (("", ""),)
        for prefix, what in both:
            words = {"{prefix}": prefix, "{what}": what}
            texts = {k: _filled(v, words) for k, v in option.items() if isinstance(v, str)}
            yield _filled(flags, words), option | texts


#: Keys of options that argparse does not know.
_OWN_KEYS = ("flags", "group", "key", "heading")


def _add(parser, groups, flags, option, known):
    """Add an option to a parser, or to its group of options of which one may be given."""
    own = {key: value for key, value in option.items() if key not in _OWN_KEYS}
    own["help"] = _filled(own["help"], known)
    if "type" in own:
        # argparse applies it to a default that is text
        own["type"] = TYPES[own["type"]]
    if own.get("action") == "boolean":
        own["action"] = argparse.BooleanOptionalAction
    if isinstance(own.get("metavar"), list):
        own["metavar"] = tuple(own["metavar"])
    if (group := option.get("group")) is not None:
        if group not in groups:
            groups[group] = parser.add_mutually_exclusive_group()
        parser = groups[group]
    parser.add_argument(*flags.split(), **own)


def _filled(text, words):
    for name, value in words.items():
        text = text.replace(name, value)
    return text


def read_input(folder):
    """Write what standard input holds, a table, beside the folder of its results: its path."""
    from miricigale.utils.files import replacing
    from miricigale.utils.options import check_that

    data = sys.stdin.buffer.read()
    kinds = {b"SIMPLE": "fits", b"# %ECSV": "ecsv", b"PAR1": "parquet", b"<?xml": "xml"}
    ending = next((kind for begin, kind in kinds.items() if data.startswith(begin)), "csv")
    path = folder.with_name(f"{folder.name}-input.{ending}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        # the same input again resumes; another is not put in its place
        same = path.is_file() and path.read_bytes() == data
        check_that(same, "output", "another folder", f"{folder}: {path} holds another input")
    else:
        with replacing(path) as partial:
            partial.write_bytes(data)
    return path
