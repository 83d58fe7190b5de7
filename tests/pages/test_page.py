import html
import re
import xml.etree.ElementTree as ElementTree
from base64 import b64decode
from io import BytesIO

import numpy as np
import pytest
from markupsafe import Markup
from matplotlib.figure import Figure
from PIL import Image

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale.pages import Link, Missing, Page, SectionWriter, number

pytestmark = pytest.mark.pictures

HOSTILE = "</script><img src=x onerror='alert(1)'> & \"co\""


def line(n=2, image=False):
    figure = Figure(figsize=(2, 2))
    ax = figure.add_subplot()
    ax.plot(np.arange(n), ".")
    if image:
        ax.imshow(np.eye(3))
    return figure


def image_in(page):
    kind, data = re.search(r"src='data:image/([^;]*);base64,([^']*)'", page).groups()
    return kind, b64decode(data)


def test_report_is_one_file_that_holds_everything(tmp_path):
    report = Page("A <title>", subtitle="made by a test")
    report.section("First & only", "5 < 6")
    report.items([("outliers", "1.5 %")])
    report.table([["miri.f770w", 1.0]], header=["band", "flux"], caption="fluxes")
    report.figure(line(), "a line")
    path = report.write(tmp_path / "report" / "index.html")
    page = path.read_text()
    assert "A &lt;title&gt;" in page
    assert "5 &lt; 6" in page
    assert "<td>miri.f770w</td>" in page
    # no reference to anything outside the file
    assert re.findall(r"(?:src|href)=['\"](?!data:|#)", page) == []
    assert [p.name for p in path.parent.iterdir()] == ["index.html"]


def test_figures_are_vectors_where_they_have_few_marks():
    drawn, caption = {}, Markup("By {}.").format(Link("<3>", "sources.html#3"))
    for name, options in {"few": {}, "many": {"n": 20_000}, "image": {"image": True}}.items():
        pages = []
        for _ in range(2):
            report = Page("title", dpi=50)
            report.figure(line(**options), caption)
            pages.append(report.to_html())
        drawn[name] = pages[0]
        # the same figure gives the same bytes
        assert pages[0] == pages[1]
        assert "alt='By &lt;3&gt;.' width='100'" in drawn[name]
        assert "By <a href='sources.html#3'>&lt;3&gt;</a>." in drawn[name]
    kind, data = image_in(drawn["few"])
    assert kind == "svg+xml"
    # the size of the figure in points, and nothing of when and by what it was made
    assert ElementTree.fromstring(data).get("width") == "144pt"
    assert b"dc:date" not in data
    for name in ("many", "image"):
        kind, data = image_in(drawn[name])
        assert kind == "png"
        with Image.open(BytesIO(data)) as image:
            assert image.size == (200, 200)


def test_what_is_missing_is_a_dash_with_its_reason():
    report = Page("title", notices=["this & that stand in"])
    rows = [("a", number(float("nan"), ".2f", "no source"), number(0.5, ".0f %", "x"))]
    report.table(rows, header=("band", "flux", "share"))
    rows += [("b", number(None, "d", "not measured"), Missing("no source"))]
    report.table(rows, header=("band", "flux", "share"))
    report.items([("outliers", Missing("no source"))])
    page = report.to_html()
    first, second = re.findall(r"<div class='table'>.*?</div>", page, re.DOTALL)
    assert "<td class=n>–</td><td class=n>50 %</td>" in first
    assert "<p class='note'>– no source</p>" in first
    # several reasons have numbers
    assert "<td class=n>–<sup>2</sup></td><td class=n>–<sup>1</sup></td>" in second
    assert "–<sup>1</sup> no source; –<sup>2</sup> not measured" in second
    assert "outliers (no source)" in page
    assert page.index("this &amp; that stand in") < page.index("<nav>")
    assert "nan" not in page.split("</style>")[1]


def test_columns_of_text_are_named_by_number_or_place():
    report = Page("made up")
    rows = [("band", 3, "a long verdict")]
    report.table(rows, header=("a", "b", "c"), text=2)
    report.table(rows, header=("a", "b", "c"), text=(0, 2))
    page = report.to_html()
    assert "<td>band</td><td>3</td><td class=n>a long verdict</td>" in page
    assert "<td>band</td><td class=n>3</td><td>a long verdict</td>" in page


def test_sections_are_filled_as_they_are_declared():
    report = Page("made up")
    writer = SectionWriter(report, cases_of(__file__))
    writer.facts = {"survey": "<CEERS>"}
    writer.notice("few", n=3)
    writer.section("bands", n=2)
    writer.items({"limit": 25.0})
    writer.figure("picture", None)
    writer.figure("picture", line())
    writer.table("table", [{"name": "F770W", "n": 3, "z": 0.123, "z_err": 0.01}])
    writer.table("plain", [{"name": "F770W", "n": 3}])
    writer.table("plain", [])
    page = report.to_html()
    # a column or number that is not there is left out
    assert "<th>name of &lt;CEERS&gt;</th><th class=n>sources</th><th class=n>offset</th>" in page
    assert "<td>F770W</td><td class=n>3</td><td class=n>+12.3 ± 1.0 %</td>" in page
    assert "<th>name</th><th class=n>n</th>" in page
    assert page.count("class='item'") == 1
    for text in ("<li>3 sources</li>", "<h2>2 bands</h2>", "<p>In two lines.</p>", "<b>25.0</b>"):
        assert text in page
    assert "<figcaption>of &lt;CEERS&gt;</figcaption>" in page
    assert "<p>No band.</p>" in page
    # what is folded stands behind its line, empty or not; the section is closed, others are open
    assert (
        len(re.findall("<summary>All of &lt;CEERS&gt;</summary>\n\\s*(?:<div|<p>No band)", page))
        == 2
    )
    assert (
        "<details><summary><h2>2 bands</h2> <span>made for &lt;CEERS&gt;</span></summary>" in page
    )


def test_tables_without_rows_are_sentences():
    report = Page("title")
    report.table([], header=("band",), empty="There is no band.")
    page = report.to_html()
    assert "<p>There is no band.</p>" in page
    assert "<table" not in page
    refuses("'rows' must be at least one", report.table, [], header=("band",))
    refuses("'rows' must be 2 cells in each row", report.table, [("a",)], header=("band", "flux"))


def test_no_text_becomes_markup():
    report = Page(HOSTILE, subtitle=HOSTILE, notices=[HOSTILE])
    report.section(HOSTILE, HOSTILE)
    report.items([(HOSTILE, HOSTILE), (HOSTILE, Missing(HOSTILE))])
    cells = (HOSTILE, Missing(HOSTILE), Link(HOSTILE, HOSTILE))
    report.table([cells], header=(HOSTILE,) * 3, caption=HOSTILE)
    report.bullets([HOSTILE])
    report.figure(line(), HOSTILE)
    page = report.to_html()
    assert "<img src=x" not in page
    assert page.count("<script>") == page.count("</script>") == 1
    assert html.unescape(page).count(HOSTILE) == 22
    # nothing ends an attribute
    assert "onerror='" not in page
