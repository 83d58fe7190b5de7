import json
import os
from pathlib import Path

import pytest

from helpers.errors import refuses
from miricigale.utils.exceptions import DataError
from miricigale.workflow.engine.store import ProductStore


def saved(store, name, text="whole"):
    """Write a product and its record."""
    store.save(name, lambda path: path.write_text(text))
    store.finish("stage", "hash", {name: store.describe(name)}, seconds=1.0)


@pytest.fixture
def folder(tmp_path):
    """A run's folder with one product, beside a file that is not its own."""
    (tmp_path / "victim").write_text("mine")
    with ProductStore(tmp_path / "run") as store:
        saved(store, "part/product.txt")
    return tmp_path / "run"


OUTSIDE = r"../victim {victim} part/../../victim .. . part//product.txt a\..\b C:x"


@pytest.mark.parametrize("name", ["", *OUTSIDE.split()])
def test_no_product_lies_outside_the_folder(folder, name):
    victim = folder.parent / "victim"
    name = name.format(victim=victim)
    text = (folder / "manifest.json").read_text()
    (folder / "manifest.json").write_text(text.replace("part/product.txt", json.dumps(name)[1:-1]))
    refuses("is not the name of a product", ProductStore, folder, error=DataError)
    assert victim.read_text() == "mine"


@pytest.mark.parametrize("link", ["part", "part/product.txt"])
def test_no_link_leads_a_product_out_of_the_folder(folder, link):
    (folder.parent / "elsewhere").mkdir()
    moved = folder.parent / "elsewhere" / "product.txt"
    os.replace(folder / "part" / "product.txt", moved)
    if link == "part":
        (folder / "part").rmdir()
        (folder / "part").symlink_to(moved.parent)
    else:
        (folder / "part" / "product.txt").symlink_to(moved)
    with pytest.raises(DataError, match=f"{link} is a symbolic link; products must lie in"):
        ProductStore(folder)
    assert moved.read_text() == "whole"


def test_a_product_cannot_be_written_through_a_link(tmp_path):
    (tmp_path / "outside").mkdir()
    with ProductStore(tmp_path / "run") as store:
        (tmp_path / "run" / "inside").symlink_to(tmp_path / "outside")
        with pytest.raises(DataError, match="inside is a symbolic link"):
            store.save("inside/x.txt", lambda path: path.write_text("x"))
    assert not list((tmp_path / "outside").iterdir())


PRODUCTS = '{"y": {"sha256": "", "bytes": 1e999}}'
STAGES = ('{"x": {}}', "[1]", f'{{"x": {{"hash": "", "seconds": 0, "products": {PRODUCTS}}}}}')
DAMAGED = [None, "", "[]", "{", "[" * 100_000, *(f'{{"stages": {one}}}' for one in STAGES)]


@pytest.mark.parametrize("name", ["manifest.json", ".manifest.copy.json"])
@pytest.mark.parametrize("text", DAMAGED)
def test_a_lost_or_damaged_manifest_is_replaced_by_its_copy(folder, name, text):
    whole = (folder / "manifest.json").read_text()
    if text is None:
        (folder / name).unlink()
    else:
        (folder / name).write_text(text)
    with ProductStore(folder) as store:
        assert store.is_current("stage", "hash")
        store.finish("other", "hash", {}, seconds=0.0)
        store.drop("other")
        store.finish("stage", "hash", store.records["stage"]["products"], seconds=1.0)
    assert (folder / name).read_text() == whole


def test_without_any_manifest_nothing_is_taken_for_a_product(folder):
    for name in ("manifest.json", ".manifest.copy.json"):
        (folder / name).write_text("{")
    text = r"neither manifest\.json nor \.manifest\.copy\.json in"
    refuses(text, ProductStore, folder, error=DataError)
    for name in ("manifest.json", ".manifest.copy.json"):
        (folder / name).unlink()
    refuses("is no run's folder", ProductStore, folder, error=DataError)
    assert (folder / "part" / "product.txt").read_text() == "whole"


def test_a_run_that_began_between_two_looks_is_no_foreign_folder(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    folder.mkdir()
    look = Path.iterdir

    def begun(self):
        monkeypatch.setattr(Path, "iterdir", look)
        with ProductStore(folder) as other:
            other.write_manifest()
        return look(self)

    monkeypatch.setattr(Path, "iterdir", begun)
    assert ProductStore(folder).is_sound


def test_a_run_that_was_killed_at_once_can_begin_again(tmp_path):
    (tmp_path / "run.lock").write_text("999999999")
    (tmp_path / ".partial-manifest.json").write_text("{")
    with ProductStore(tmp_path) as store:
        assert store.records == {}
    assert not list(tmp_path.glob(".partial-*"))
