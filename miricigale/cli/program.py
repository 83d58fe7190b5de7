"""The program ``miricigale``: its commands, and what it says of input that cannot be used."""

import gc
import importlib
import logging
import os
import signal
import sys
import threading

from miricigale.cli.options import in_options, in_our_names, make_parser

# shells add the number of the signal to this
_STOPPED = 128

# objects that are made before Python looks for those in circles: imports make hundreds of thousands that stay, and
# to search through them all again and again took 5 % of the time of `miricigale photometry`
_GARBAGE_THRESHOLD = 50_000


def main(argv=None):
    """
    Entry point of the ``miricigale`` command.

    Parameters
    ----------
    argv : list of str, optional
        Arguments; those of the process if not given.

    Returns
    -------
    status : int
        0 if all went well, 2 for input that cannot be used, 130 if interrupted, 143 if terminated, 141 if the
        reader of its output left.
    """
    if argv is None:
        argv = sys.argv[1:]
    parser = make_parser(argv)
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)
    argv, taken = in_our_names(argv, parser.every_name)
    for flag, name in taken.items():
        print(f"miricigale {parser.typed}: {flag} is taken as {name}", file=sys.stderr)
    args = parser.parse_args(argv)
    verbose = getattr(args, "verbose", False)
    quiet = getattr(args, "quiet", False)
    args.progress_bar = not quiet and getattr(args, "progress_bar", True)
    _log_to_screen(verbose, quiet)
    if args.version:
        from miricigale import __version__

        print(__version__)
        return 0
    if args.command is None:
        parser.print_help()
        return 2
    try:
        _keep_output_clean()
        module, _, function = args.call.partition(":")
        status = getattr(importlib.import_module(f"miricigale.cli.{module}"), function)(args)
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        # the reader, such as `head`, has enough; what is left in the buffer goes nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _STOPPED + signal.SIGPIPE
    except KeyboardInterrupt as stop:
        print(args.stopped, file=sys.stderr)
        return _STOPPED + (stop.args[0] if stop.args else signal.SIGINT)
    except Exception as err:
        from astropy.units import UnitsError

        # one clear sentence for input that cannot be used; the traceback is for --verbose
        expected = (ValueError, KeyError, OSError, ImportError, MemoryError, UnitsError)
        if verbose or not isinstance(err, expected):
            raise
        text = in_options(_sentence(err), args.option_names)
        notes = "".join(f" ({note})" for note in getattr(err, "__notes__", ()))
        print(f"miricigale: {text}{notes}", file=sys.stderr)
        return 2


def _sentence(err):
    """Return the message of an error in one line."""
    if not isinstance(err, KeyError):
        return " ".join(str(err).split())
    message = ""
    if err.args:
        message = str(err.args[0])
    if " " in message:
        return " ".join(message.split())
    # the message of a KeyError may be the key alone
    return f"{type(err).__name__} {message}"


def _log_to_screen(verbose, quiet):
    """Show log records: warnings, with ``verbose`` notes too, with ``quiet`` errors alone."""
    handler = logging.StreamHandler()
    handler.addFilter(lambda record: _is_logged(record, verbose))
    level = logging.WARNING
    if verbose:
        level = logging.INFO
    elif quiet:
        level = logging.ERROR
    logging.basicConfig(level=level, format="%(message)s", handlers=[handler])
    if not quiet:
        # what is compiled, and what is fitted, is said at any verbosity
        for name in (
            "utils.compilation",
            "fitting.catalogs.from_files",
            "fitting.catalogs.class_names",
        ):
            logging.getLogger(f"miricigale.{name}").setLevel(logging.INFO)


def command():
    """Run `main` as the whole of a process; see there."""
    # batch systems end a job by SIGTERM: it is left as by an interrupt, its lock taken off
    signal.signal(signal.SIGTERM, _terminate)
    gc.set_threshold(_GARBAGE_THRESHOLD)
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    threads = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    if status > _STOPPED and not all(thread.daemon for thread in threads):
        # threads in compiled code ignore interrupts, and the interpreter would wait for them
        os._exit(status)
    sys.exit(status)


def _is_logged(record, verbose):
    """Whether a log record goes to our handler; astropy's warnings have a handler of their own."""
    if not record.name.startswith("astropy"):
        return True
    return verbose and _is_note(record)


def _is_note(record):
    return record.levelno <= logging.INFO


def _is_no_note(record):
    return not _is_note(record)


def _keep_output_clean():
    """Keep astropy's notes (INFO) off standard output, where tables are."""
    from astropy import log

    for handler in log.handlers:
        if _is_no_note not in handler.filters:
            handler.addFilter(_is_no_note)


def _terminate(signum, frame):
    raise KeyboardInterrupt(signum)
