"""References of a CRDS cache, by the rules of ``crds``."""

import pytest

from helpers.cases import cases_of
from helpers.errors import refuses
from helpers.references import imager_keywords, write_cache
from miricigale.reduction import ReferenceCache
from miricigale.utils.exceptions import DataError

pytest.importorskip("crds", reason="needs crds: pip install miricigale[jwst]")

HEADER = imager_keywords(DETECTOR="MIRIMAGE", BAND="N/A")
HEADER |= {"DATE-OBS": "2022-07-03", "TIME-OBS": "12:30:00.500"}

RULES = {name: tuple(rule.values()) for name, rule in cases_of(__file__).items()}


@pytest.fixture
def folder(tmp_path):
    write_cache(tmp_path, RULES)
    for name in ("ground", "flight", "later", "generic", "sub64", "two", "one"):
        (tmp_path / "references/jwst/miri" / f"{name}.fits").touch()
    return tmp_path


def chosen(folder, **header):
    files = ReferenceCache(folder, incomplete=True).find({**HEADER, **header})
    return {name: path.name for name in files.names() if (path := getattr(files, name)) is not None}


def test_rules_choose_by_the_header(folder):
    assert chosen(folder) == {"gain": "flight.fits", "flat": "sub64.fits", "dark": "two.fits"}
    ground = {"gain": "ground.fits"}
    assert chosen(folder, **{"DATE-OBS": "2018-03-08"}) == {**ground, "flat": "sub64.fits"}
    # without a filter there is no flat field
    other = {"DATE-OBS": "2021-03-08", "FILTER": "F560W"}
    assert chosen(folder, **other) == {**ground, "dark": "one.fits"}
    # the generic file has one match less
    assert chosen(folder, SUBARRAY="FULL")["flat"] == "generic.fits"
    files = ReferenceCache(folder).find(HEADER)
    assert files.origin == "jwst_0001.pmap"
    assert files.gain == folder / "references/jwst/miri/flight.fits"


def test_the_context_is_that_of_the_variable_or_the_last(folder, monkeypatch):
    write_cache(folder, {}, context="jwst_0002.pmap")
    assert ReferenceCache(folder).context == "jwst_0002.pmap"
    monkeypatch.setenv("CRDS_CONTEXT", "jwst_0001.pmap")
    monkeypatch.setenv("CRDS_PATH", str(folder))
    assert ReferenceCache().context == "jwst_0001.pmap"
    assert ReferenceCache(context="jwst_0002.pmap").find(HEADER).missing() != ()


def test_what_is_not_there_is_named(folder, tmp_path, monkeypatch):
    monkeypatch.delenv("CRDS_PATH", raising=False)
    refuses("'folder' must be given, or the variable CRDS_PATH set", ReferenceCache)
    refuses("is no CRDS cache of JWST", ReferenceCache, tmp_path / "nothing", error=DataError)
    with pytest.raises(DataError, match=r"is no CRDS cache of JWST with jwst_0009\.pmap"):
        ReferenceCache(folder, "jwst_0009.pmap")
    (folder / "references/jwst/miri/flight.fits").unlink()
    with pytest.raises(DataError, match=r"lacks the reference file flight\.fits, which jwst_0001"):
        chosen(folder)
