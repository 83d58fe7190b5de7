"""Steps of a measurement, as a session shows them."""

import contextlib

from miricigale.utils.progress import in_session, progress

#: Steps of a measurement at most.
N_STEPS = 4
#: Pixels of images whose measurement takes some ten seconds, from which on sessions show the steps.
LARGE = 200_000


class Steps:
    """
    Names the step of a measurement that is done.

    Parameters
    ----------
    bar : object
        Of `~miricigale.utils.progress.progress`.
    """

    def __init__(self, bar):
        self._bar = bar

    def begin(self, name):
        """Show the step that begins, and that the one before it is done."""
        if self._bar.desc:
            self._bar.update()
        self._bar.set_description(f"photometry, {name}")


@contextlib.contextmanager
def measurement_steps(show, n_pixels):
    """
    Show the steps of a measurement.

    Parameters
    ----------
    show : bool or None
        Whether they are shown; None for those of large images in sessions.
    n_pixels : int
        Pixels that are fitted.

    Yields
    ------
    steps : `Steps`
    """
    if show is None:
        show = in_session() and n_pixels > LARGE
    with progress(show=show, total=N_STEPS, unit="steps") as bar:
        yield Steps(bar)
        bar.update()
