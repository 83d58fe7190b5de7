"""The page of a study while it is filled, and the products that its sections show."""

import functools

from miricigale.pages import SectionWriter
from miricigale.utils.package_tables import declared
from miricigale.workflow.labels import band_label, three_bands, truth_label
from miricigale.workflow.page.numbers import FEWEST, MIPS_LIMIT
from miricigale.workflow.truths import FIELD


class DeclaredPage(SectionWriter):
    """
    A page of a run that is filled with what ``sections.toml`` declares.

    Parameters
    ----------
    report : `~miricigale.pages.Page`
        The page.
    context : `~miricigale.workflow.Context`
        The run.
    """

    def __init__(self, report, context):
        super().__init__(report, declared("miricigale.workflow.page", "sections.toml"))
        self.context = context
        self.config = context.config

    def numbers(self, name, table, **facts):
        """Save numbers as ``report/<name>.ecsv``, and begin the section on them."""
        self.context.save_table(f"report/{name}.ecsv", table)
        self.section(name, **facts)


class StudyPage(DeclaredPage):
    """
    What the sections of a study's page read, and the page that they fill.

    Parameters
    ----------
    report, context
        As for `DeclaredPage`.
    truth_tables : dict of str to `~miricigale.workflow.page.numbers.StudyTables`
        Of the truths of whose sky the analysis knows all, the reference first.
    study : `~miricigale.evaluation.StudyResults`
        The same.
    metrics : dict
        Plain numbers of the field, the bands and the fits (``report/metrics.json``).
    kernels : dict of str to `~miricigale.psf.MatchingKernel`
        With their PSFs, by band.
    model : `~miricigale.sed.SEDModel`
        That of the fits.
    area : `~astropy.units.Quantity`
        Solid angle of the imaged field.
    """

    def __init__(self, report, context, truth_tables, study, metrics, kernels, model, area):
        super().__init__(report, context)
        self.truth_tables = truth_tables
        self.study = study
        self.first = study.truths[0]
        self.tables = truth_tables[self.first.name]
        self.bands = self.config.exposures.filters
        self.metrics = metrics
        self.kernels = kernels
        self.model = model
        self.area = area

    @functools.cached_property
    def facts(self):
        """Values that the sentences name, by name."""
        config = self.config
        longest = [band_label(name) for name in three_bands(self.bands)]
        facts = self.metrics | {
            "truth": truth_label(self.first),
            "three_bands": ", ".join(longest),
            "longest": longest[-1],
            "detected_bands": "the one band" if len(self.bands) == 1 else "two or more bands",
            "prior": band_label(config.highres.filter),
            "mag_column": config.catalog.mag_column,
            "mag_limit": config.catalog.mag_limit,
            "mips_limit": MIPS_LIMIT,
            "fewest": FEWEST,
            "model_error": 100 * config.fit.model_error,
            "cosmology": self.model.meta["cosmology"],
            "frac_agn_definition": self.model.meta["frac_agn_definition"],
        }
        has_model_error = config.fit.model_error > 0
        keeps_energy = config.sed.infrared == "fit"
        optional = {
            "wide": has_model_error,
            "same_templates": keeps_energy,
            "own_models": has_model_error and keeps_energy,
            "field_agn": FIELD in config.sed.frac_agn,
        }
        for name, is_true in optional.items():
            facts[name] = ""
            if is_true:
                facts[name] = self.texts["optional"][name].format(**facts)
        return facts

    @property
    def band_rows(self):
        """Numbers of each band, with its name and what it is called."""
        rows = []
        for name, entry in self.metrics["bands"].items():
            rows.append({"name": name, "band": band_label(name)} | entry)
        return rows
