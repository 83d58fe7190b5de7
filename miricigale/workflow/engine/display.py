"""What a run says of its progress."""

import collections
import logging
import re

from miricigale.utils.exceptions import warn
from miricigale.utils.folder import MANIFEST
from miricigale.utils.progress import on_terminal, print_line, progress

log = logging.getLogger(__name__)


class Display:
    """A bar on a terminal, otherwise a line for each stage, or nothing."""

    def __init__(self, show, units, keys):
        self._units = units
        self.is_bar = show and on_terminal()
        self._lines = show and not self.is_bar
        self._bar = progress(total=len(keys), show=self.is_bar, desc="study", unit="step")
        self._spent = {}
        self._facts = collections.Counter()

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self._bar.close()
        if n_repeats := self._facts.total() - len(self._facts):
            log.warning(
                "%d more such warnings of other units: 'warnings' in %s", n_repeats, MANIFEST
            )

    def warn(self, category, text):
        """Show a warning, once for units that differ in what it quotes, such as the band."""
        fact = re.sub(r"'[^']*'", "", text)
        self._facts[fact] += 1
        if self._facts[fact] == 1:
            warn(text, category)

    def begin(self, titles):
        self._bar.set_description(", ".join(titles))

    def finish(self, stage, seconds):
        """A unit of a stage is done."""
        self._bar.update()
        spent = self._spent.setdefault(stage.name, [])
        spent.append(seconds)
        if self._lines and len(spent) == len(self._units[stage.name]) and any(spent):
            units = ""
            if len(spent) > 1:
                units = f" ({len(spent)})"
            print_line(f"{stage.title}{units}: {sum(spent):.1f} s")
