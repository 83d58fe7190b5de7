"""BibTeX of citations."""

import re
from pathlib import Path

import pytest

from miricigale.cli.bibliography import bibtex
from miricigale.utils.package_tables import declared

PAPERS = declared("miricigale.cli", "papers.toml")


@pytest.mark.parametrize(
    ("citation", "identifier"),
    [
        ("Yang et al. 2021, ApJ 908, 144", "2021ApJ...908..144Y"),
        ("Boquien et al. 2019, A&A, 622, A103", "2019A%26A...622A.103B"),
        ("Carnall et al. 2018, MNRAS 480, 4379 (bagpipes)", "2018MNRAS.480.4379C"),
        ("Finkelstein et al. 2023, ApJL 946, L13", "2023ApJ...946L..13F"),
        ("Skelton et al. 2014, ApJS, 214, 24", "2014ApJS..214...24S"),
        ("Ferland et al. 2017, RMxAA 53, 385 (Cloudy)", "2017RMxAA..53..385F"),
        ("van der Wel et al. 2012, ApJS, 203, 24", "2012ApJS..203...24V"),
        ("by way of bagpipes, Bruzual & Charlot 2003, MNRAS 344, 1000", "2003MNRAS.344.1000B"),
    ],
)
def test_papers_have_their_identifiers_in_ads(citation, identifier):
    entry = bibtex([citation])
    assert entry.startswith("@article{")
    assert f"adsurl = {{https://ui.adsabs.harvard.edu/abs/{identifier}}}" in entry


def test_each_paper_is_there_once_whatever_is_said_besides():
    citations = [
        "Draine & Li 2007, ApJ 657, 810; by way of bagpipes, Carnall et al. 2018, MNRAS 480, 4379",
        "Carnall et al. 2018, MNRAS 480, 4379 (bagpipes)",
        "Boquien et al. 2019, A&A 622, A103, eq. 3",
        "Vasan et al. 2025, arXiv:2512.15477",
        "JWST user documentation (MIRI dithering)",
    ]
    text = bibtex(citations)
    keys = re.findall(r"^@(\w+)\{(\w+),", text, re.MULTILINE)
    assert keys == [
        ("article", "draine2007"),
        ("article", "carnall2018"),
        ("article", "boquien2019"),
        ("misc", "vasan2025"),
        ("misc", "jwst"),
    ]
    assert "author = {Draine and Li}" in text
    assert "eprint = {2512.15477}" in text
    assert "note = {JWST user documentation (MIRI dithering)}" in text


def test_the_package_has_author_title_and_version():
    """What CITATION.cff says of it."""
    text = bibtex(["miricigale 1.2.3 (CITATION.cff)"])
    assert text.startswith("@misc{miricigale,\n  author = {{The miricigale developers}},")
    assert "title = {miricigale}" in text
    assert "version = {1.2.3}" in text


def test_two_papers_of_an_author_and_year_have_two_keys():
    text = bibtex(["Carnall et al. 2018, MNRAS 480, 4379", "Carnall et al. 2018, MNRAS 481, 1"])
    assert re.findall(r"\{(\w+),\n", text) == ["carnall2018", "carnall2018_2"]


@pytest.mark.parametrize(
    ("citation", "title", "doi"),
    [
        # of CITATION.cff and of the papers themselves
        ("Yang et al. 2021, ApJ 908, 144", "Simulated Imaging", "10.3847/1538-4357/abd6c1"),
        ("Boquien et al. 2019, A&A 622, A103, eq. 3", "{CIGALE}", "10.1051/0004-6361/201834156"),
        ("Draine & Li 2007, ApJ 657, 810", "Interstellar Dust. {IV}", "10.1086/511055"),
        ("Vasan et al. 2025, arXiv:2512.15477", "", "10.48550/arXiv.2512.15477"),
    ],
)
def test_titles_and_dois_where_they_are_known(citation, title, doi):
    entry = bibtex([citation])
    assert f"  doi = {{{doi}}},\n" in entry
    assert title in entry


def test_each_title_is_of_a_paper_that_is_cited():
    """By identifiers as they are made of citations; braces of BibTeX are closed."""
    for identifier, fields in PAPERS.items():
        assert re.fullmatch(r"\d{4}[\w&.]{14}[A-Z]", identifier), identifier
        assert set(fields) <= {"title", "doi"}
        assert fields.get("title", "").count("{") == fields.get("title", "").count("}")
        assert re.fullmatch(r"10\.\d{4,5}/\S+", fields.get("doi", "10.1086/511055"))
    # as volume and page say
    assert "doi" not in bibtex(["Draine & Li 2007, ApJ 657, 811"])


def test_titles_of_the_paper_are_those_of_its_bibliography():
    path = Path(__file__).parents[2] / "paper" / "paper.bib"
    text = path.read_text()
    titles = {fields["title"] for fields in PAPERS.values() if "title" in fields}
    of_paper = set(re.findall(r"title = \{(.*)\},?$", text, re.MULTILINE))
    shared = titles & of_paper
    assert len(shared) >= 6, titles - of_paper
