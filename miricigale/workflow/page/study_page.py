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
        self.context, self.config = context, context.config

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
    every : dict of str to `~miricigale.workflow.page.numbers.StudyTables`
        The tables of the truths of whose sky the analysis knows all, the reference first.
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

    def __init__(self, report, context, every, study, metrics, kernels, model, area):
        super().__init__(report, context)
        self.every, self.study, self.first = every, study, study.truths[0]
        self.tables = every[self.first.name]
        self.bands = self.config.exposures.filters
        self.metrics, self.kernels, self.model, self.area = metrics, kernels, model, area

    @functools.cached_property
    def facts(self):
        """What the sentences say of the run: dict of str to values."""
        config, chosen = self.config, [band_label(n) for n in three_bands(self.bands)]
        facts = self.metrics | {
            "truth": truth_label(self.first),
            "three_bands": ", ".join(chosen),
            "longest": chosen[-1],
            "detected_bands": "the one band" if len(self.bands) == 1 else "two or more bands",
            "prior": band_label(config.highres.filter),
            "mag_column": config.catalog.mag_column,
            "mag_limit": config.catalog.mag_limit,
            "mips_limit": MIPS_LIMIT,
            "fewest": FEWEST,
            "model_error": 100 * config.fit.model_error,
            **{name: self.model.meta[name] for name in ("cosmology", "frac_agn_definition")},
        }
        wide, own = config.fit.model_error > 0, config.sed.infrared == "fit"
        true = {"wide": wide, "same_templates": own, "own_models": wide and own}
        true["field_agn"] = FIELD in config.sed.frac_agn
        texts = self.texts["optional"]
        return facts | {name: texts[name].format(**facts) if true[name] else "" for name in true}

    @property
    def band_rows(self):
        """The numbers of each band, with its name and what it is called."""
        return [
            {"name": name, "band": band_label(name), **entry}
            for name, entry in self.metrics["bands"].items()
        ]
