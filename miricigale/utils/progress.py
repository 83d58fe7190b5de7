"""Progress bars: off in the API unless asked for, on in the command line."""

from tqdm.auto import tqdm

__all__ = ["progress"]


def progress(iterable=None, *, show=False, total=None, desc=None, unit="it"):
    """Wrap an iterable in a tqdm bar (`tqdm.auto.tqdm`), silent unless ``show``."""
    return tqdm(iterable, total=total, desc=desc, unit=unit, disable=not show, leave=False)
