"""Each bundled file has a record, a license, and the text of that license in the wheel."""

import hashlib
import importlib.metadata
import json
import re
from importlib import resources as importlib_resources
from pathlib import Path

import pytest

from miricigale.refdata import resources

ROOT = Path(__file__).parents[2]
BUNDLED = {record.file: record for record in resources().values() if record.kind == "bundled"}


def license_of(record):
    """SPDX identifiers and the package that they are the license of."""
    form = r"([\w.+-]+(?: AND [\w.+-]+)*) \(([\w-]+)\)(?:;.*)?"
    expression, package = re.fullmatch(form, record.licence).groups()
    return expression.split(" AND "), package


def text_of(identifier, package):
    return "LICENSE.rst" if package == "miricigale" else f"licenses/{identifier}_{package}.txt"


def test_every_bundled_file_has_a_record_and_is_the_one_that_it_describes():
    folder = Path(str(importlib_resources.files("miricigale.refdata") / "files"))
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*.*")}
    assert sorted(found) == sorted(BUNDLED)
    for name, path in found.items():
        assert hashlib.sha256(path.read_bytes()).hexdigest() == BUNDLED[name].sha256, name
        assert (ROOT / BUNDLED[name].script).is_file(), name


@pytest.mark.parametrize("name", BUNDLED)
def test_a_file_from_another_package_has_its_license(name):
    record = BUNDLED[name]
    identifiers, package = license_of(record)
    listed = (ROOT / "licenses/README.rst").read_text(encoding="utf-8")
    assert f"``{name}``" in listed
    for identifier in identifiers:
        assert (ROOT / text_of(identifier, package)).stat().st_size > 1000
        assert re.search(rf"``{re.escape(name)}`` .*{re.escape(identifier)}", listed)
    if package != "miricigale":
        assert package in record.source


def test_the_wheel_names_all_licenses_and_holds_their_texts():
    wheel = importlib.metadata.distribution("miricigale")
    origin = json.loads(wheel.read_text("direct_url.json") or "{}")
    if wheel.read_text("WHEEL") is None or origin.get("dir_info", {}).get("editable"):
        pytest.skip("needs an installed wheel: an editable one is as old as its installation")
    licenses = [license_of(record) for record in BUNDLED.values()]
    pairs = {(each, package) for identifiers, package in licenses for each in identifiers}
    stated = wheel.metadata["License-Expression"].split(" AND ")
    assert sorted(stated) == sorted({identifier for identifier, _ in pairs})
    texts = {str(path).partition("licenses/")[2] for path in wheel.files}
    assert {text_of(*pair) for pair in pairs} <= texts
