"""The numbers of Yang et al. 2021, compared with those of a study."""

import dataclasses
import tomllib
from importlib import resources

import numpy as np

from miricigale.evaluation.estimates import Estimate
from miricigale.evaluation.quantities import QUANTITIES, SHARES, measure
from miricigale.utils.named_values import attributes
from miricigale.utils.options import check_names
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import described_rows

#: Differences below this many errors are none.
_AGREES = 2.0
#: Difference in sigma from which only that it is larger is said: errors are not known to a part of that.
_FAR = 10.0
#: Verdict of numbers of a study of other exposures.
OTHER_EXPOSURES = "other exposures"


@dataclasses.dataclass(frozen=True)
class PublishedNumber:
    """
    A number of Yang et al. 2021 (ApJ 908, 144).

    Parameters
    ----------
    key : str
        Unique name.
    quantity : str
        Name of `~miricigale.evaluation.QUANTITIES`, or ``"extra"`` for one of other products.
    value : float
        What the paper has.
    text : str
        What it is of.
    section : str
        Part of the paper's results.
    error : float, optional
        The paper's error or range; none by default.
    tolerance : float, optional
        Largest difference that counts as none, of numbers without errors.
    relation : str, optional
        ``"="``, ``"~"`` (about), ``"<"`` (a bound of the size, on both sides) or ``">"`` (a bound).
    truth : float or None, optional
        Injected AGN fraction; None for those above 0 together.
    band_set : str, optional
        MIRI bands of the fit.
    option : optional
        A band, magnitude, bin of redshift or class.
    definition : str, optional
        How it is taken.
    source : str, optional
        Section or figure of the paper in which it stands.
    why : str, optional
        What explains the difference of the study of the preset, as measured.
    n : int, optional
        Sources of the paper's sample; by default as many as the study's.

    Examples
    --------
    >>> from miricigale.evaluation import PUBLISHED
    >>> one = next(one for one in PUBLISHED if one.key == "power_scatter")
    >>> one.value, one.source
    (0.3, 'abstract, section 3.3.4')
    """

    key: str
    quantity: str
    value: float
    text: str
    section: str
    error: float = 0.0
    tolerance: float = 0.0
    relation: str = "="
    truth: float | None = 0.0
    band_set: str = "all"
    option: object = None
    definition: str = ""
    source: str = ""
    why: str = ""
    n: int = 0


_FILE = resources.files("miricigale.evaluation") / "yang2021.toml"
_TABLE = tomllib.loads(_FILE.read_text(encoding="utf-8"))


def _published(fields):
    """Return a number from its fields in the file."""
    fields["definition"] = fields.get("definition", "").format_map(_TABLE["texts"])
    fields["why"] = _TABLE["measured"].get(fields["key"], "")
    if fields.get("truth") == "above 0":
        fields["truth"] = None
    if isinstance(fields.get("option"), list):
        fields["option"] = tuple(fields["option"])
    return PublishedNumber(**fields)


#: All numbers that are compared.
PUBLISHED = tuple(
    _published(group | number) for group in _TABLE["group"] for number in group.pop("numbers")
)


def compare_with_paper(study, *, seed, n_draws=1000, reasons=None, same_exposures=True):
    """
    Compare every published number with that of a study.

    Parameters
    ----------
    study : `~miricigale.evaluation.StudyResults`
        The tables; numbers of other products are taken from its ``extra``, by key.
    seed : int
        Of the bootstrap; each number has its own stream.
    n_draws : int, optional
        Draws of the bootstrap.
    reasons : dict of str to str, optional
        Why numbers differ, by key, instead of the general reasons.
    same_exposures : bool, optional
        Whether bands and exposures are those of the paper. Otherwise numbers that depend on the depth (all but
        those of detection, kernels and bright points) stand next to the paper's without a verdict.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each of `PUBLISHED`: ``key``, ``section``, ``description``, ``relation``, ``paper``,
        ``paper_err``, ``ours`` with its 68 % interval ``low``, ``high``, ``n``, ``completeness`` (the
        share of the sources of the field that ours is of), ``of_all`` (for shares of right sources: their
        share among all sources of the field), ``sigma`` (difference in units of its error; 0 where a bound
        holds), ``verdict``, ``definition`` and ``source``.

    Raises
    ------
    KeyError
        If ``reasons`` has a key that no published number has.
    """
    seed = check_seed(seed)
    reasons = dict(reasons or {})
    rows = []
    check_names(reasons, "published number", [published.key for published in PUBLISHED])
    for published in PUBLISHED:
        if published.quantity == "extra":
            ours = study.extra.get(published.key, Estimate(np.nan))
        else:
            choice = attributes(published, ("truth", "band_set", "option"))
            choice["seed"] = stream(seed, "paper", published.key)
            ours = measure(study, published.quantity, **choice, n_draws=n_draws)
        sigma = np.nan
        verdict = OTHER_EXPOSURES
        if same_exposures or published.quantity == "extra":
            sigma = _difference(published, ours)
            why = reasons.get(published.key, published.why)
            verdict = _verdict(published, ours, sigma, why)
        description = published.text
        if QUANTITIES.get(published.quantity):
            description = f"{QUANTITIES[published.quantity]}: {description}"
        of_all = np.nan
        if published.quantity == "class_share":
            of_all = ours.value * ours.completeness
        rows.append(
            {
                "key": published.key,
                "section": published.section,
                "description": description,
                "relation": published.relation,
                "paper": published.value,
                "paper_err": published.error,
                "ours": ours.value,
                "low": ours.low,
                "high": ours.high,
                "n": ours.n,
                "completeness": ours.completeness,
                "of_all": of_all,
                "sigma": sigma,
                "verdict": verdict,
                "definition": published.definition,
                "source": published.source,
            }
        )
    return described_rows(rows, _TABLE["columns"])


def _difference(number, ours):
    """Difference in units of its error; that of the paper is ours, where it has none, for its sample."""
    delta = _excess(number, ours)
    if (number.relation == "<" and delta <= 0) or (number.relation == ">" and delta >= 0):
        return 0.0
    error = np.nan_to_num(ours.error)
    size = number.n or ours.n or 1
    published = number.error or error * np.sqrt((ours.n or size) / size)
    if number.quantity in SHARES and ours.n:
        # our interval is none for theirs where one of the shares is near 0 or 1
        published = max(published, np.sqrt(number.value * (1 - number.value) / size))
    total = np.hypot(error, published)
    if total > 0:
        return float(delta / total)
    return np.nan


def _excess(published, ours):
    """Tell how much our value, or of a bound its size, is above the published one."""
    value = ours.value
    if published.relation == "<":
        value = abs(value)
    return value - published.value


def _verdict(published, ours, sigma, why):
    """Tell whether the two agree, in words."""
    if not np.isfinite(ours.value):
        return "not measured"
    if published.relation in "<>" and sigma == 0:
        return "within the bound"
    if not np.isfinite(sigma):
        delta = _excess(published, ours)
        if abs(delta) <= published.tolerance:
            return f"agrees (to {published.tolerance:g})"
        return f"differs by {delta:+.3g}: {why or 'open'}"
    if abs(sigma) >= _AGREES:
        if abs(sigma) < _FAR:
            size = f"{sigma:+.1f}"
        else:
            size = f"more than {_FAR:g}"
        return f"differs by {size} sigma: {why or 'open'}"
    if published.relation in "<>":
        delta = _excess(published, ours)
        return f"agrees within its error: beyond the bound by {abs(delta):.2g} ({sigma:+.1f} sigma)"
    return f"agrees ({sigma:+.1f} sigma)"
