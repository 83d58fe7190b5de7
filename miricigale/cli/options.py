"""The parser of the program, from the declarations of ``commands.toml``."""

import argparse
import contextlib
import difflib
import inspect
import re
import sys
import textwrap
import tomllib
from importlib import resources
from pathlib import Path

from miricigale.utils.files import make_folder
from miricigale.utils.named_values import without
from miricigale.utils.options import check_that
from miricigale.utils.table_formats import WRITTEN_FORMATS


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one sentence."""

    def error(self, message):
        """Say what is wrong with the arguments, the nearest name that there is, and end with status 2."""
        choice = re.search(r"invalid choice: '?(.+?)'? \(choose from (.+)\)", message)
        unknown = re.match(r"unrecognized arguments: (.+)", message)
        hint = ""
        if choice:
            names = [name.strip(" '") for name in choice[2].split(",")]
            hint = _nearest_command(choice[1], names)
        elif unknown:
            flags = [word.partition("=")[0] for word in unknown[1].split() if word[0] == "-"]
            hint = "".join(_nearest_option(flag, self.every_name) for flag in flags)
        prog = f"{self.prog} {self.typed}".strip()
        self.exit(2, f"{self.prog}: {message}{hint} (see {prog} --help)\n")

    #: The command that was typed, and its flags and positional arguments, for the nearest one to a wrong one.
    typed = ""
    every_name = ()


def _other_names(kind):
    """Return the names of other programs for commands or options of ours."""
    return declarations("other_names.toml")[kind]


def _meant(name):
    return f"; did you mean {name!r}?"


def _nearest_command(name, names):
    """Say which command, or choice, may be meant; empty if none is near."""
    # what is meant is more than what is spelled alike
    if "run" in names and name in _other_names("no_commands"):
        sentences = _other_names("no_commands")
        return f"; {sentences.get(sentences[name], sentences[name])}"
    command = _other_names("commands").get(name)
    if command in names or command == "--help":
        return _meant(command)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    if close:
        return _meant(close[0])
    return ""


def in_our_names(argv, names):
    """
    Put options of ours in place of those of another name that take the same.

    Parameters
    ----------
    argv : list of str
        What was typed.
    names : sequence of str
        Flags and positional arguments of the command.

    Returns
    -------
    argv : list of str
    taken : dict of str to str
        Options of ours by the names in place of which they stand.
    """
    others = _other_names("options")
    words = []
    taken = {}
    for word in argv:
        flag, equals, value = word.partition("=")
        if flag.startswith("--") and flag not in names:
            for name in others.get(flag[2:].replace("_", "-"), ()):
                if name in names:
                    taken[flag] = name
                    break
        words.append(taken.get(flag, flag) + equals + value)
    return words, taken


def _nearest_option(flag, names):
    """Say which option of a command may be meant, or that an argument has none."""
    word_typed = flag.lstrip("-")
    argument = word_typed.replace("-", "_").upper()
    if argument in names:
        return f"; {argument} has no option before it"
    flags = [name for name in names if name.startswith("-")]
    word = word_typed.replace("_", "-")
    for name in _other_names("near_options").get(word, ()):
        if name in flags:
            return _meant(name)
    option, sentence = _other_names("sentences").get(word, (None, ""))
    if option in flags:
        return f"; {sentence}"
    # the last word of an option, such as --unit for --flux-unit, or its first letters
    ending = [name for name in flags if name.endswith("-" + word_typed)]
    beginning = [name for name in flags if name.startswith("--" + word_typed)]
    for likely in (ending, beginning):
        if len(likely) == 1:
            return _meant(likely[0])
    # the dashes that all have make short names seem alike
    full_names = {name.lstrip("-"): name for name in flags}
    close = difflib.get_close_matches(word_typed, full_names, n=1, cutoff=0.65)
    if close:
        return _meant(full_names[close[0]])
    return ""


def quantity_in(unit):
    """Return the type of an option that is a number in a unit, or with one of its own: 300, 300s, "5 min"."""

    def number(text):
        import astropy.units as u

        try:
            return float(text) * u.Unit(unit)
        except ValueError:
            pass
        try:
            return u.Quantity(text).to(unit)
        except (TypeError, ValueError) as err:
            msg = f"must be a number in {unit}, or with another unit, got {text!r}"
            raise argparse.ArgumentTypeError(msg) from err

    return number


def number_in(unit):
    """Return the type of an option that is the value in a unit of what `quantity_in` reads."""
    quantity = quantity_in(unit)
    return lambda text: float(quantity(text).value)


def pair(text):
    """Return two names that stand with a colon between them."""
    names = tuple(text.split(":"))
    if len(names) != 2 or not all(names):
        msg = f"{text!r} is no pair NAME:NAME"
        raise argparse.ArgumentTypeError(msg)
    return names


def extension(text):
    """Return the number or name of an extension of a FITS file."""
    if text.isdigit():
        return int(text)
    return text


def number_or_file(text):
    """Return a text as a number where it is one; others name files."""
    try:
        return float(text)
    except ValueError:
        return text


#: Endings of files that people name as an output, where a command writes a folder.
_FILE_ENDINGS = {
    *WRITTEN_FORMATS,
    ".asdf",
    ".cat",
    ".gz",
    ".html",
    ".json",
    ".pdf",
    ".png",
    ".toml",
}


def output_folder(text):
    """Return the path of a folder that a command writes; refuse a file, and a name that is one of a file."""
    path = Path(text)
    if path.is_dir():
        return path
    if path.exists():
        msg = f"must be a folder, {text} is a file"
        raise argparse.ArgumentTypeError(msg)
    if path.suffix.lower() in _FILE_ENDINGS:
        name = path.name
        while Path(name).suffix.lower() in _FILE_ENDINGS:
            name = Path(name).stem
        folder = path.with_name(name)
        msg = f"must be a folder, for several files are written; got {text} (such as {folder})"
        raise argparse.ArgumentTypeError(msg)
    return path


#: Types of options by their names in the declarations.
TYPES = {
    "int": int,
    "float": float,
    "path": Path,
    "folder": output_folder,
    "pair": pair,
    "extension": extension,
    "number or file": number_or_file,
    "arcsec": quantity_in("arcsec"),
    "deg": quantity_in("deg"),
    "seconds": number_in("s"),
    "hours": number_in("h"),
    "degrees": number_in("deg"),
    "days": number_in("day"),
    "square arcmin": number_in("arcmin2"),
}


def destination(flags, option):
    """Return the name of the argument that a declared option becomes."""
    longest = max(flags.split(), key=len)
    return option.get("dest", longest.lstrip("-").replace("-", "_"))


def filled(args, *functions):
    """
    Return the options that are named like parameters of functions, or like fields of settings.

    Parameters
    ----------
    args : `argparse.Namespace`
        The options of a command.
    *functions : callable
        What they are passed to; these declare the defaults.

    Returns
    -------
    options : dict of str to object
        Without those that were not given (None).
    """
    names = set()
    for function in functions:
        names.update(inspect.signature(function).parameters)
    options = {}
    for name, value in vars(args).items():
        if name in names and value is not None:
            options[name] = value
    return options


def refuse(args, names, wanted):
    """Refuse options that mean nothing with others: none of ``names`` may be given."""
    for name in names:
        value = getattr(args, name)
        check_that(value is None or value is False, name, wanted, value)


def declarations(file="commands.toml"):
    """Return what a file declares: of each command and of ``shared`` options, or names of other programs."""
    return tomllib.loads((resources.files("miricigale.cli") / file).read_text("utf-8"))


@contextlib.contextmanager
def workers(scheduler, n_threads, memory=None):
    """
    Processes of this machine, or the workers of a dask scheduler, as an executor of a run that is resumed.

    None on one thread: this process works itself, for another one would import the package once more.
    """
    from miricigale.utils.exceptions import OtherResultsError
    from miricigale.utils.parallel import process_pool, thread_count
    from miricigale.workflow.engine.cluster import cluster_executor

    n_processes = thread_count(n_threads or None)
    if scheduler is not None:
        pool = cluster_executor(scheduler, memory=memory)
    elif n_processes > 1:
        pool = process_pool(n_processes)
    else:
        pool = contextlib.nullcontext()
    try:
        with pool as executor:
            yield executor
    except OtherResultsError as err:
        # name the option of the command instead of the argument
        raise OtherResultsError(err.reason, "--redo to replace it") from err


def make_parser(argv):
    """Return the parser of the program; help texts are complete where they are asked for."""
    words = {}
    words_typed = [word for word in argv if not word.startswith("-")]
    if not argv or {"-h", "--help"} & set(argv):
        from miricigale.filters.surveys import SURVEYS
        from miricigale.workflow.config import preset_names

        words = {"{presets}": ", ".join(preset_names()), "{surveys}": ", ".join(SURVEYS)}
    declared = declarations()
    shared = declared.pop("shared")
    verbosity = argparse.ArgumentParser(add_help=False, argument_default=argparse.SUPPRESS)
    group = verbosity.add_mutually_exclusive_group()
    group.add_argument("-v", "--verbose", action="store_true", help="say what is done")
    group.add_argument("-q", "--quiet", action="store_true", help="errors and warnings only")
    description = "Plan and analyze JWST/MIRI deep imaging."
    # a part of a name of another program, such as --model, would be taken for an option of ours
    parser = Parser(
        prog="miricigale", description=description, parents=[verbosity], allow_abbrev=False
    )
    parser.add_argument("--version", action="store_true", help="print the version and stop")
    # parsers of commands by the name of their group, empty for that of the program
    parsers = {"": parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=Parser)}
    for name, command in declared.items():
        group, _, word = name.rpartition(" ")
        text = _replaced(command["help"], words)
        command_parser = parsers[group].add_parser(
            word,
            help=text,
            # examples stand in lines of their own, so that argparse wraps neither
            description=textwrap.fill(
                command.get("description", f"{text[0].upper()}{text[1:]}."), 78
            ),
            epilog="examples:\n  " + "\n  ".join(command["examples"]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            parents=[verbosity],
            allow_abbrev=False,
        )
        if "call" not in command:
            parsers[name] = command_parser.add_subparsers(
                dest="action", metavar="ACTION", required=True
            )
            continue
        options = command.get("options", {})
        for source, flags in command.get("as_in", {}).items():
            for flag in flags:
                options[flag] = declared[source]["options"][flag]
        for key in command.get("shared", ()):
            options[shared[key]["flags"]] = shared[key]
        _add_options(command_parser, options, words)
        names = _option_names(command_parser)
        command_parser.set_defaults(
            call=command["call"],
            stopped=command.get("stopped", "miricigale: stopped"),
            option_names=names,
        )
        if words_typed[: name.count(" ") + 1] == name.split():
            parser.typed = name
            parser.every_name = tuple(names.values())
    return parser


def _add_options(parser, options, words):
    """Add the options of a command, under their headings."""
    groups = {}
    section = parser
    title = None
    for flags, option in _of_both(options):
        # an option of image and prior has its heading twice
        if option.get("heading", title) != title:
            title = option["heading"]
            section = parser.add_argument_group(title)
        target = parser
        if flags.startswith("-"):
            target = section
        _add(target, groups, flags, option, words)


def _option_names(parser):
    """What a user types for each argument of a command: its longest flag, or what a positional one is called."""
    names = {}
    for action in parser._actions:
        if action.option_strings:
            names.setdefault(action.dest, max(action.option_strings, key=len))
        else:
            names[action.dest] = action.metavar or action.dest
    # the folder of the products
    for destination in ("patches", "output"):
        if destination in names:
            names.setdefault("folder", names[destination])
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
        r"'(\w+)'(?= must | is | column '| given\))|(?<=\(or )'(\w+)'(?=\))",
        lambda match: names.get(match[1] or match[2], match[0]),
        message,
    )


def _of_both(options):
    """Yield options, those of image and prior once for each."""
    for flags, option in options.items():
        variants = [{"{prefix}": "", "{what}": ""}]
        if "{prefix}" in flags:
            variants = [
                {"{prefix}": "", "{what}": "image"},
                {"{prefix}": "highres-", "{what}": "prior"},
            ]
        for words in variants:
            replaced = dict(option)
            for key, value in option.items():
                if isinstance(value, str):
                    replaced[key] = _replaced(value, words)
            yield _replaced(flags, words), replaced


#: Keys of options that argparse does not know.
_EXTRA_KEYS = ("flags", "group", "key", "heading")


def _add(parser, groups, flags, option, words):
    """Add an option to a parser, or to its group of options of which one may be given."""
    arguments = without(option, _EXTRA_KEYS)
    arguments["help"] = _replaced(arguments["help"], words)
    if "type" in arguments:
        # argparse applies it to a default that is text
        arguments["type"] = TYPES[arguments["type"]]
    if arguments.get("action") == "boolean":
        arguments["action"] = argparse.BooleanOptionalAction
    if isinstance(arguments.get("metavar"), list):
        arguments["metavar"] = tuple(arguments["metavar"])
    if (group := option.get("group")) is not None:
        if group not in groups:
            groups[group] = parser.add_mutually_exclusive_group()
        parser = groups[group]
    parser.add_argument(*flags.split(), **arguments)


def _replaced(text, words):
    for name, value in words.items():
        text = text.replace(name, value)
    return text


def read_input(folder):
    """Write the table that standard input holds to a file next to the folder of its results; return its path."""
    from miricigale.utils.files import replacing
    from miricigale.utils.options import check_that

    data = sys.stdin.buffer.read()
    endings = {b"SIMPLE": "fits", b"# %ECSV": "ecsv", b"PAR1": "parquet", b"<?xml": "xml"}
    ending = "csv"
    for begin, name in endings.items():
        if data.startswith(begin):
            ending = name
    path = folder.with_name(f"{folder.name}-input.{ending}")
    make_folder(path.parent)
    if path.exists():
        # the same input again resumes; another is not put in its place
        is_same = path.is_file() and path.read_bytes() == data
        check_that(is_same, "output", "another folder", f"{folder}: {path} holds another input")
    else:
        with replacing(path) as partial:
            partial.write_bytes(data)
    return path
