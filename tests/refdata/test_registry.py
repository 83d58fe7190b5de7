"""Records and registries."""

import re

from helpers.errors import refuses
from miricigale.refdata import Registry, citations, resource, resources


def test_every_record_says_where_it_comes_from():
    for name, record in resources().items():
        assert record.name == name
        assert record.kind in ("bundled", "package", "user")
        assert all([record.title, record.licence, record.citation, record.source]), name
        if record.kind == "bundled":
            assert re.fullmatch(r"[0-9a-f]{64}", record.sha256), name
            assert record.script.startswith("tools/"), name
            assert record.file, name


def test_citations_are_sorted_without_repeats():
    names = ["instrument.thermal", "filters.sedpy", "instrument.thermal"]
    found = citations(*names)
    assert found == sorted({resource(name).citation for name in names})
    assert len(found) == 2


def test_registry_loads_on_first_use():
    calls = []
    registry = Registry("thing")
    registry.register("a", lambda name: calls.append(name) or name.upper(), color="red")
    assert registry.metadata("a") == {"color": "red"}
    assert calls == []
    assert registry.get("a") == "A"
    assert calls == ["a"]
    assert "a" in registry
    assert registry.names() == ["a"]


def test_registry_refuses():
    registry = Registry("thing")
    registry.register("a", str)
    refuses("thing 'a' is registered already", registry.register, "a", str)
    refuses("no thing 'b'; known: a", registry.get, "b", error=KeyError)
