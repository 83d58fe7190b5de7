"""The section on the inputs and published relations."""

from miricigale.workflow.page import band_figures
from miricigale.workflow.page.labels import band_label


def write_inputs(page):
    """Luminosities, star formation, counts and light of the galaxies of the reference truth."""
    galaxies, imaged = page.tables.galaxies(), page.tables.galaxies(field=True)
    page.section("inputs")
    if len(galaxies) == 0:
        page.text("no_model")
        return
    figure, left_out = band_figures.input_figure(galaxies)
    page.figure("sequence", figure, n_not_shown=left_out, n_galaxies=len(galaxies))
    if len(imaged) == 0:
        page.text("none_imaged")
        return
    figure = band_figures.counts_figure(imaged, page.bands, page.area)
    page.figure("counts", figure, n_imaged=len(imaged))
    rows = [
        row
        | {
            "band": f"{band_label(row['band'])}, {row['wavelength']:g} µm",
            "faint_limit": f"{row['least']:g} µJy" if row["least"] else "none",
            "published": f"{row['published']:.2f} -{row['down']:.2f} +{row['up']:.2f}",
        }
        for row in page.metrics["light"]
    ]
    page.table("light", rows)
