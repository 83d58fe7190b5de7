import re

from matplotlib.figure import Figure

from miricigale.evaluation import Report


def test_report_is_one_file_that_holds_everything(tmp_path):
    report = Report("A <title>", subtitle="made by a test")
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
