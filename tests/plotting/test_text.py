"""Text that users bring is drawn as it is, whatever matplotlib would read in it."""

import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import CCDData, StdDevUncertainty
from matplotlib import cbook
from matplotlib.figure import Figure
from matplotlib.text import Text

from miricigale import BayesFitter, SEDModel
from miricigale.filters import Filter, FilterSet
from miricigale.instrument.image import Image
from miricigale.plotting.axes import label_outer, panels, plain_text
from miricigale.plotting.comparison import plot_error_function
from miricigale.plotting.curves import plot_filters
from miricigale.plotting.measurements import plot_energies
from miricigale.psf import InstrumentPSF

#: Formulas, pieces of them, and what ends matplotlib's parser of formulas.
NASTY = [
    "$$",
    "$",
    "$a$",
    r"$\frac{$",
    r"a\$b$c$",
    "cost 5$ or 6$",
    "$_$",
    "a_b^c",
    r"\alpha",
    "%s {x}",
]


def drawn_texts(ax):
    """All text of a figure that matplotlib takes for no formula, as it is shown, after it was drawn."""
    ax.figure.draw_without_rendering()
    texts = [text.get_text() for text in ax.figure.findobj(Text)]
    # as in Text._preprocess_math
    return [text.replace(r"\$", "$") for text in texts if not cbook.is_math_text(text)]


def axes():
    return Figure().subplots()


@pytest.mark.parametrize("name", NASTY)
def test_escaped_text_is_no_formula(name):
    ax = axes()
    ax.set_title(plain_text(name))
    ax.plot([0, 1], label=plain_text(name))
    ax.legend()
    assert drawn_texts(ax).count(name) == 2


def test_unescaped_text_ends_in_an_error():
    ax = axes()
    ax.set_title(r"$\frac{$")
    with pytest.raises(ValueError, match="Expected"):
        ax.figure.draw_without_rendering()


@pytest.fixture(scope="module")
def results():
    """A fit of objects with such ids."""
    bands = ["wfc3.f160w", "miri.f770w", "miri.f1000w"]
    model = SEDModel.yang2021(agn=False)
    truth = {"id": NASTY, "redshift": [1.0] * len(NASTY), "age": 1.0, "mass": 1e10 * u.Msun}
    photometry = model.fluxes(truth, bands)
    for name in bands:
        photometry[f"{name}_err"] = 0.1 * photometry[name]
    axes = {"redshift": [0.8, 1.0, 1.2], "age": [1.0, 3.0]}
    return BayesFitter(model, bands, axes=axes).fit(photometry)


@pytest.mark.parametrize("row", range(len(NASTY)))
def test_ids_stand_in_figures_of_fits(results, row):
    ax = axes()
    one = results[row]
    one.plot_sed(ax)
    title = next(text for text in drawn_texts(ax) if "chi2 = " in text)
    assert title.startswith(f"{NASTY[row]}: z = ")


@pytest.mark.parametrize("name", NASTY)
def test_names_of_bands_stand_in_figures(name):
    curve = Filter(name, [1.0, 1.1, 1.2] * u.um, [0.0, 1.0, 0.0])
    other = Filter("b", [1.0, 1.1, 1.2] * u.um, [0.0, 1.0, 0.0])
    assert name in drawn_texts(FilterSet([curve, other]).plot(axes()))
    values = {name: np.array([1.0, 2.0]), "b": np.array([1.0, 3.0])}
    assert name in drawn_texts(plot_error_function(values, values, ax=axes()))
    assert name in drawn_texts(plot_energies([0.1, 0.2], values, ax=axes()))
    assert name in drawn_texts(plot_filters([([1.0, 2.0], [0.0, 1.0], name)] * 2, ax=axes()))
    _, by_name = panels([name, "b"])
    label_outer(by_name, "x", "y")
    assert name in drawn_texts(next(iter(by_name.values())))


@pytest.mark.parametrize("name", NASTY)
def test_images_are_labeled_with_any_filter(name):
    data = np.arange(25.0).reshape(5, 5)
    image = CCDData(data, unit="MJy/sr", uncertainty=StdDevUncertainty(np.ones((5, 5))))
    image.meta["filter"] = name
    shown = drawn_texts(Image(image).plot(axes()))
    assert any(text.startswith(f"{name} (MJy / sr)") for text in shown)
    psf = InstrumentPSF(
        np.ones((5, 5)) / 25, pixel_scale=0.1 * u.arcsec, filter=name, frame="detector"
    )
    assert any(text.startswith(name) for text in drawn_texts(psf.plot(axes())))
