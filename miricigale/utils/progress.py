"""Progress: on in the command line, and for long work in sessions; off in scripts unless asked for."""

import contextlib
import sys
import time

from tqdm import tqdm

#: Seconds between lines where no bar is drawn.
_EVERY = 60.0
#: Seconds after which a bar is drawn that shows by default in interactive sessions.
_DELAY = 3.0


def in_session():
    """Whether a person waits at a prompt or a notebook, where a bar can be drawn."""
    if "ipykernel" in sys.modules:
        return True
    at_prompt = hasattr(sys, "ps1") or bool(sys.flags.interactive)
    return at_prompt and sys.stderr.isatty()


def on_terminal():
    """Whether a bar can be drawn: in a terminal or a notebook, not in a log file."""
    return "ipykernel" in sys.modules or sys.stderr.isatty()


def print_line(text):
    """Write a line to stderr, beside whatever bar is drawn there."""
    if on_terminal():
        tqdm.write(text, file=sys.stderr)
    else:
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()


class _Lines(contextlib.AbstractContextManager):
    """What `progress` returns where no bar is drawn: one line at the end, one a minute, or none."""

    def __init__(self, iterable, total, desc, unit, show):
        self.iterable = iterable
        self.desc = desc
        self.unit = unit
        self._show = show
        if total is None and hasattr(iterable, "__len__"):
            total = len(iterable)
        self.total = total
        self.n = 0
        self._begin = time.monotonic()
        self._last = self._begin

    def update(self, n=1):
        self.n += n
        if time.monotonic() - self._last > _EVERY:
            self._line()

    def set_description(self, desc):
        self.desc = desc

    def close(self):
        if self.n:
            self._line()
        self.n = 0

    def _line(self):
        self._last = time.monotonic()
        if self._show:
            share = f"{self.n}"
            if self.total is not None:
                share += f" of {self.total}"
            label = ""
            if self.desc:
                label = f"{self.desc}: "
            print_line(f"{label}{share} {self.unit}, {self._last - self._begin:.0f} s")

    def __iter__(self):
        with self:
            for item in self.iterable:
                yield item
                self.update()

    def __exit__(self, *exc):
        self.close()


def progress(iterable=None, *, show=False, total=None, desc=None, unit="it"):
    """
    Show how far a loop is.

    Parameters
    ----------
    iterable : iterable, optional
        What is looped over; without it the caller calls ``update``.
    show : bool, optional
        Whether anything is shown; for None a bar in sessions alone (`in_session`), of loops after some seconds.
    total : int, optional
        Number of steps.
    desc, unit : str, optional
        Label, and what a step is.

    Returns
    -------
    bar : `tqdm.auto.tqdm` or an object with the same ``update``, ``set_description`` and ``close``
        A bar; where stderr is no terminal, lines: one at the end and one a minute.
    """
    delay = 0.0
    if show is None:
        show = in_session()
        delay = _DELAY
    if not (show and on_terminal()):
        # without tqdm, whose semaphore outlives a process that is stopped
        return _Lines(iterable, total, desc, unit, show)
    # the notebook's bar is slow to import
    from tqdm.auto import tqdm

    return tqdm(iterable, total=total, desc=desc, unit=unit, leave=False, delay=delay)
