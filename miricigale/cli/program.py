"""The program ``miricigale``: its commands, and what it says of input that cannot be used."""

import argparse
import logging
import os
import signal
import sys
import threading

from miricigale.cli.catalogs import add_fit, add_photometry
from miricigale.cli.data import add_data, add_filters
from miricigale.cli.exposures import add_reduce
from miricigale.cli.study import add_compile, add_plan, add_run

# shells add the number of the signal to this
_STOPPED = 128


def _parser():
    parser = argparse.ArgumentParser(
        prog="miricigale", description="Plan and analyze JWST/MIRI deep imaging."
    )
    parser.add_argument("--version", action="store_true", help="print the version and stop")
    parser.add_argument("-v", "--verbose", action="store_true", help="say what is done")
    parser.set_defaults(stopped=lambda _: "miricigale: stopped")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")

    for add in (
        add_run,
        add_fit,
        add_photometry,
        add_reduce,
        add_plan,
        add_filters,
        add_compile,
        add_data,
    ):
        add(commands)
    return parser


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
        0 if all went well, 2 for input that cannot be used, 130 if interrupted, 143 if terminated.
    """
    parser = _parser()
    args = parser.parse_args(argv)
    handler = logging.StreamHandler()
    # astropy has a handler of its own
    handler.addFilter(lambda record: not record.name.startswith("astropy"))
    logging.basicConfig(
        level=logging.INFO if args.verbose else logging.WARNING,
        format="%(message)s",
        handlers=[handler],
    )
    # messages about compilation are shown at any verbosity
    logging.getLogger("miricigale.utils.compilation").setLevel(logging.INFO)
    if args.version:
        from miricigale import __version__

        print(__version__)
        return 0
    if args.command is None:
        parser.print_help()
        return 2
    try:
        return args.call(args)
    except KeyboardInterrupt as stop:
        print(args.stopped(args), file=sys.stderr)
        return _STOPPED + (stop.args[0] if stop.args else signal.SIGINT)
    except Exception as err:
        from astropy.units import UnitsError

        # one clear sentence for input that cannot be used; the traceback is for --verbose
        expected = (ValueError, KeyError, OSError, ImportError, UnitsError)
        if args.verbose or not isinstance(err, expected):
            raise
        message = err.args[0] if isinstance(err, KeyError) and err.args else err
        # the message of a KeyError may be the key alone
        bare = isinstance(err, KeyError) and " " not in str(message)
        kind = f"{type(err).__name__} " if bare else ""
        where = "".join(f" ({note})" for note in getattr(err, "__notes__", ()))
        print(f"miricigale: {kind}{' '.join(str(message).split())}{where}", file=sys.stderr)
        return 2


def command():
    """Run `main` as the whole of a process; see there."""
    # batch systems end a job by SIGTERM: it is left as by an interrupt, its lock taken off
    signal.signal(signal.SIGTERM, _terminate)
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    if status > _STOPPED and not all(thread.daemon for thread in others):
        # threads in compiled code ignore interrupts, and the interpreter would wait for them
        os._exit(status)
    sys.exit(status)


def _terminate(signum, frame):
    raise KeyboardInterrupt(signum)
