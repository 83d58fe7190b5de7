"""What is taken from the fits of a catalog of AGN: selection, posteriors in bins, evidences of the classes."""

import astropy.units as u
import numpy as np

from miricigale.evaluation import classify
from miricigale.evaluation.classes import CLASS_LIMITS
from miricigale.utils.arrays import nans, quiet_division
from miricigale.utils.options import check_that
from miricigale.utils.units import LUMINOSITY
from miricigale.utils.values import value_class

#: Classes whose fits have an AGN luminosity.
_WITH_AGN = ("galaxy", "quasar")


@value_class
class FittedSample:
    """
    What is taken from the fits of a catalog, by object.

    ``tables`` are posteriors in bins of the classes with AGN, ``log_evidence`` is of all classes, and ``main`` the
    class of the highest evidence.
    """

    ids: np.ndarray
    used: np.ndarray
    selected: np.ndarray
    main: np.ndarray
    redshift: np.ndarray
    log_luminosity: np.ndarray
    frac_agn: np.ndarray
    tables: dict
    log_evidence: dict
    axis: object

    def __len__(self):
        return len(self.ids)

    @classmethod
    def of_fits(cls, fits, bins, limit):
        """Of fits of the same catalog by class."""
        columns = {name: _columns(results, bins) for name, results in fits.items()}
        evidence = np.array([values["log_evidence"] for values in columns.values()])
        names = np.array(list(columns))
        main = names[np.argmax(np.where(np.isnan(evidence), -np.inf, evidence), axis=0)]
        galaxy = columns["galaxy"]
        usable = np.isfinite(galaxy["weights"].sum(axis=(1, 2, 3)))
        values = {}
        for name in ("redshift", "log_luminosity", "frac_agn"):
            values[name] = galaxy[name].copy()
            if "quasar" in columns:
                quasars = main == "quasar"
                values[name][quasars] = columns["quasar"][name][quasars]
        fraction = np.where(np.isfinite(values["frac_agn"]), values["frac_agn"], np.nan)
        selected = classify(fraction, limits=(CLASS_LIMITS[0], limit)) == "agn"
        selected &= np.isin(main, _WITH_AGN)
        tables = {}
        for name in _WITH_AGN:
            if name in columns:
                tables[name] = columns[name]["weights"]
        log_evidence = {}
        for name, of_class in columns.items():
            log_evidence[name] = of_class["log_evidence"]
        first = next(iter(fits["galaxy"].parts()))
        axis = first.axes.get("frac_agn")
        check_that(axis is not None, "axes", "a grid with several AGN fractions", "one without")
        return cls(
            galaxy["ids"], usable, selected, main, **values, tables=tables,
            log_evidence=log_evidence, axis=axis,
        )  # fmt: skip

    def other_classes(self):
        """Other classes of the objects that are used, as `draw_shares` takes them."""
        posteriors = {}
        for name, evidence in self.log_evidence.items():
            if name == "galaxy":
                continue
            ratio = (evidence - self.log_evidence["galaxy"])[self.used]
            table = self.tables.get(name)
            if table is not None:
                table = np.nan_to_num(table[self.used])
            posteriors[name] = ratio, table
        return posteriors

    def shipped(self):
        """Posteriors as they were fitted, all classes being equally frequent: as `ShareDraws.probability`."""
        other_classes = self.other_classes()
        evidence = [np.zeros(int(self.used.sum()))]
        evidence += [
            np.where(np.isnan(ratio), -np.inf, ratio) for ratio, _ in other_classes.values()
        ]
        evidence = np.array(evidence)
        weight = np.exp(evidence - evidence.max(axis=0))
        weight = weight / weight.sum(axis=0)
        probability = {}
        for name, part in zip(["galaxy"] + list(other_classes), weight, strict=True):
            table = self.tables.get(name)
            if table is None:
                probability[name] = part
            else:
                probability[name] = part[:, None, None, None] * np.nan_to_num(table[self.used])
        return probability


def _columns(results, bins):
    """Arrays of a class for all objects: dict by name."""
    by_name = {}
    for part in results.parts():
        n = len(part)
        columns = {"ids": np.array(part.ids), "log_evidence": np.array(part.log_evidence)}
        columns["weights"] = part.agn_weights
        if part.agn_weights is None:
            columns["weights"] = nans((n,) + tuple(bins.shape))
        for name in ("redshift", "frac_agn", bins.quantity):
            values = nans(n)
            if name in part.parameters:
                values = part.median(name)
            elif name in part.best:
                values = part.best[name]
            columns[name] = np.array(u.Quantity(values).value, float)
        with quiet_division():
            log_luminosity = np.log10(columns.pop(bins.quantity) * LUMINOSITY.to("erg / s"))
        columns["log_luminosity"] = log_luminosity
        for name, values in columns.items():
            by_name.setdefault(name, []).append(values)
    return {name: np.concatenate(parts) for name, parts in by_name.items()}
