"""Folders of files with a record; that of runs is tested in tests/workflow/test_store.py."""

import json

from helpers.errors import refuses
from miricigale.utils.exceptions import DataError
from miricigale.utils.folder import RecordFolder


class Parts(RecordFolder):
    """Part files of a fit, of which there is an earlier layout of the manifest."""

    purpose, lock_name, records_name = "fit", "fit.lock", "parts"

    def parse(self, values):
        if values.get("format") != "parts-1":
            return super().parse(values)
        parts = values["parts"].items()
        records = {name: {"hash": "old", "products": {name: dict(part)}} for name, part in parts}
        return {"job": values["job"]}, records


def write(store, name, text):
    store.save(name, lambda path: path.write_text(text))
    store.finish(name, "hash", {name: store.describe(name)}, rows=len(text))


def test_what_was_noted_is_there_again(tmp_path):
    with Parts(tmp_path / "fit") as store:
        store.facts["job"] = {"chunk_rows": 3}
        write(store, "part-0.txt", "abc")
    again = Parts(tmp_path / "fit")
    assert again.facts == {"job": {"chunk_rows": 3}}
    assert again.records["part-0.txt"]["rows"] == 3
    assert again.is_current("part-0.txt", "hash")
    assert not again.is_current("part-1.txt", "hash")
    with again:
        again.drop("part-0.txt")
        again.write_manifest()
    assert not (tmp_path / "fit" / "part-0.txt").exists()
    assert Parts(tmp_path / "fit").records == {}


def test_records_outlive_a_kill_at_any_byte_of_the_journal(tmp_path):
    """A record counts from the moment at which its line is whole; the manifests get it at the end."""
    folder = tmp_path / "fit"
    with Parts(folder) as store:
        write(store, "part-0.txt", "abc")
    with Parts(folder) as store:
        for k in (1, 2):
            write(store, f"part-{k}.txt", "abc")
        assert "part-1" not in (folder / "manifest.json").read_text()
        journal = (folder / ".manifest.journal").read_bytes()
    assert set(json.loads((folder / "manifest.json").read_text())["parts"]) == set(store.records)
    assert not (folder / ".manifest.journal").exists()
    with Parts(folder) as store:
        store.records = {"part-0.txt": store.records["part-0.txt"]}
        store.write_manifest()
    first_end = journal.index(b"\n", 1)
    for n in range(len(journal) + 1):
        (folder / ".manifest.journal").write_bytes(journal[:n])
        n_whole = 1 + (n >= first_end) + (n >= len(journal) - 1)
        assert len(Parts(folder).records) == n_whole
    # a line that could not be written wholly costs itself only
    (folder / ".manifest.journal").write_bytes(journal[: first_end - 5] + journal[first_end + 1 :])
    again = Parts(folder)
    assert set(again.records) == {"part-0.txt", "part-2.txt"}
    assert not again.is_sound
    with again:
        assert not (folder / ".manifest.journal").exists()
    assert set(Parts(folder).records) == {"part-0.txt", "part-2.txt"}


def test_a_removed_record_stays_removed_after_a_kill(tmp_path):
    with Parts(tmp_path) as store:
        write(store, "part-0.txt", "abc")
    with Parts(tmp_path) as store:
        store.drop("part-0.txt")
        journal = (tmp_path / ".manifest.journal").read_bytes()
        write(store, "part-0.txt", "abc")
    (tmp_path / ".manifest.journal").write_bytes(journal)
    assert Parts(tmp_path).records == {}


def test_an_earlier_layout_stays_readable(tmp_path):
    with Parts(tmp_path) as store:
        write(store, "part-0.txt", "abc")
        product = store.describe("part-0.txt")
    old = {"format": "parts-1", "job": {"chunk_rows": 3}, "parts": {"part-0.txt": product}}
    (tmp_path / "manifest.json").write_text(json.dumps(old))
    (tmp_path / ".manifest.copy.json").unlink()
    store = Parts(tmp_path)
    assert store.facts == {"job": {"chunk_rows": 3}}
    assert store.is_whole("part-0.txt")
    assert not store.is_sound


def test_messages_say_whose_folder_it_is(tmp_path):
    (tmp_path / "mine").write_text("x")
    refuses("is no fit's folder; choose another folder", Parts, tmp_path, error=DataError)
    match, other = r"is in use by a fit: .* remove .*fit\.lock", Parts(tmp_path / "fit")
    with Parts(tmp_path / "fit"):
        refuses(match, other.__enter__, error=DataError)
