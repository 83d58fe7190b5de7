import re

import pytest
from matplotlib.figure import Figure

from miricigale.pages import Missing, Page, number


def test_report_is_one_file_that_holds_everything(tmp_path):
    report = Page("A <title>", subtitle="made by a test")
    report.section("First & only", "5 < 6")
    report.items([("outliers", "1.5 %")])
    report.table([["miri.f770w", 1.0]], header=["band", "flux"], caption="fluxes")
    figure = Figure()
    figure.add_subplot().plot([0, 1])
    report.figure(figure, "a line", name="line", folder=tmp_path / "figures")
    path = report.write(tmp_path / "report" / "index.html")
    page = path.read_text()
    assert "A &lt;title&gt;" in page
    assert "5 &lt; 6" in page
    assert "<td>miri.f770w</td>" in page
    # no reference to anything outside the file
    assert re.findall(r"(?:src|href)=['\"](?!data:|#)", page) == []
    assert "data:image/png;base64,iVBOR" in page
    assert (tmp_path / "figures" / "line.png").read_bytes()[:4] == b"\x89PNG"
    assert [p.name for p in path.parent.iterdir()] == ["index.html"]


def test_what_is_missing_is_a_dash_with_its_reason(tmp_path):
    report = Page("title", notices=["this & that stand in"])
    rows = [
        ("a", number(float("nan"), ".2f", "no source"), number(0.5, "{:.0f} %", "x", scale=100))
    ]
    report.table(rows, header=("band", "flux", "share"))
    rows += [("b", number(None, "d", "not measured"), Missing("no source"))]
    report.table(rows, header=("band", "flux", "share"))
    report.items([("outliers", Missing("no source"))])
    page = report.to_html()
    first, second = re.findall(r"<div class='table'>.*?</div>", page)
    assert "<td class=n>–</td><td class=n>50 %</td>" in first
    assert "<p class='note'>– no source</p>" in first
    # several reasons are told apart
    assert "<td class=n>–<sup>2</sup></td><td class=n>–<sup>1</sup></td>" in second
    assert "–<sup>1</sup> no source; –<sup>2</sup> not measured" in second
    assert "outliers (no source)" in page
    assert page.index("this &amp; that stand in") < page.index("<nav>")
    assert "nan" not in page.split("</style>")[1]


def test_columns_of_text_are_named_by_number_or_place(tmp_path):
    report = Page("made up")
    rows = [("band", 3, "a long verdict")]
    report.table(rows, header=("a", "b", "c"), text=2)
    report.table(rows, header=("a", "b", "c"), text=(0, 2))
    page = report.write(tmp_path / "page.html").read_text()
    assert "<td>band</td><td>3</td><td class=n>a long verdict</td>" in page
    assert "<td>band</td><td class=n>3</td><td>a long verdict</td>" in page


def test_tables_without_rows_are_sentences():
    report = Page("title")
    report.table([], header=("band",), empty="There is no band.")
    page = report.to_html()
    assert "<p>There is no band.</p>" in page
    assert "<table" not in page
    with pytest.raises(ValueError, match="'rows' must be at least one"):
        report.table([], header=("band",))
    with pytest.raises(ValueError, match="'rows' must be 2 cells in each row"):
        report.table([("a",)], header=("band", "flux"))


def test_pages_are_the_same_bytes():
    pages = []
    for _ in range(2):
        report = Page("title")
        figure = Figure(figsize=(2, 2))
        figure.add_subplot().plot([0, 1])
        report.figure(figure, "a line")
        pages.append(report.to_html())
    assert pages[0] == pages[1]
