"""Tables between the nodes are shared by fits of the same models, and by no others."""

import astropy.units as u
import pytest
from astropy.table import QTable
from numpy.testing import assert_array_equal

from miricigale.fitting import BayesFitter
from miricigale.sed import SEDModel

BANDS = ["wfc3.f160w", "irac.ch1", "miri.f770w", "miri.f1500w"]
MODEL = SEDModel.yang2021(agn=False)
AXES = {"redshift": [0.5, 0.8, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.4], "tau": [1.0]}


@pytest.fixture(scope="module")
def photometry():
    """A galaxy between the nodes."""
    truth = QTable({"id": [1], "redshift": [0.8], "mass": [1e10] * u.Msun})
    truth["age"] = 2.0
    truth["ebv"] = 0.25
    truth["tau"] = 1.0
    fluxes = MODEL.fluxes(truth, BANDS)
    table = QTable({"id": [1]})
    for band in BANDS:
        table[band] = fluxes[band]
        table[f"{band}_err"] = 0.03 * fluxes[band]
    return table


def moments(photometry, axes, bands=BANDS):
    fitter = BayesFitter(MODEL, bands, axes=axes, model_error=0.01)
    return fitter.fit(photometry).moments


@pytest.mark.parametrize(
    "change",
    [{"redshift": [0.4, 0.8, 1.1]}, {"age": [1.0, 4.0]}, {"tau": [3.0]}, {"alpha": [2.5]}],
    ids=lambda change: next(iter(change)),
)
@pytest.mark.filterwarnings("ignore:.*not fitted")
def test_a_fit_does_not_take_the_tables_of_another(photometry, change):
    """Numbers of a fit with other nodes or constants do not depend on what was fitted before."""
    # fits of other bands, after which nothing is kept of the one that follows
    for bands in (BANDS[:3], BANDS[1:]):
        moments(photometry, AXES, bands)
    alone = moments(photometry, AXES | change)
    for bands in (BANDS[:3], BANDS[1:]):
        moments(photometry, AXES, bands)
    moments(photometry, AXES)
    assert_array_equal(moments(photometry, AXES | change), alone)
    assert_array_equal(moments(photometry, AXES | change), alone)
