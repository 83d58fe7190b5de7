"""Entries for BibTeX of what products name to be cited."""

import collections
import re

from miricigale.utils.package_tables import declared

#: Journals: how citations name them, the macro of ADS, and their code in the identifiers of ADS.
_JOURNALS = {
    "ApJ": (r"\apj", "ApJ.."),
    "ApJL": (r"\apjl", "ApJ.."),
    "ApJS": (r"\apjs", "ApJS."),
    "AJ": (r"\aj", "AJ..."),
    "MNRAS": (r"\mnras", "MNRAS"),
    "A&A": (r"\aap", "A&A.."),
    "RMxAA": (r"\rmxaa", "RMxAA"),
}

_ARTICLE = re.compile(
    r"(?P<authors>[^,;(]+?),? \(?(?P<year>(?:19|20)\d\d)\)?,? "
    r"(?P<journal>"
    + "|".join(map(re.escape, _JOURNALS))
    + r"),? (?P<volume>\d+), (?P<page>[AL]?\d+)"
)
_PREPRINT = re.compile(
    r"(?P<authors>[^,;(]+?),? \(?(?P<year>(?:19|20)\d\d)\)?,? arXiv:(?P<number>\d{4}\.\d{4,5})"
)
_PACKAGE = re.compile(r"miricigale (?P<version>\S+) ")
_DATED = re.compile(r"(?P<authors>[^,;(]+?),? \(?(?P<year>(?:19|20)\d\d)\b")


def bibtex(citations):
    r"""
    Make entries for BibTeX.

    Parameters
    ----------
    citations : iterable of str
        Such as ``"Yang et al. 2021, ApJ 908, 144"``, several in one text with semicolons.

    Returns
    -------
    text : str
        An ``@article`` of each paper in a journal, with its page in ADS, which has all authors; with title and DOI
        where ``papers.toml`` has them. A ``@misc`` of everything else, whose note is the citation. Each is there
        once.

    Examples
    --------
    >>> from miricigale.cli.bibliography import bibtex
    >>> print(bibtex(["Yang et al. 2021, ApJ 908, 144"]))
    @article{yang2021,
      author = {Yang and others},
      year = {2021},
      title = {{JWST/MIRI} Simulated Imaging: Insights into ... Galaxies in Deep Surveys},
      doi = {10.3847/1538-4357/abd6c1},
      journal = {\apj},
      volume = {908},
      pages = {144},
      adsurl = {https://ui.adsabs.harvard.edu/abs/2021ApJ...908..144Y}
    }
    """
    n_keys = collections.Counter()
    entries = {}
    for citation in citations:
        for work in citation.split(";"):
            kind, fields = _entry(work.strip())
            content = ",\n".join(f"  {name} = {{{value}}}" for name, value in fields.items())
            if (kind, content) in entries:
                continue
            entries[kind, content] = _key(work, fields, n_keys)
    return "\n".join(f"@{kind}{{{key},\n{content}\n}}" for (kind, content), key in entries.items())


def _entry(work):
    """Return the kind of an entry and its fields: (str, dict of str)."""
    # what a library came by is cited as itself
    paper = re.sub(r"^by way of [^,]+, ", "", work)
    if match := _ARTICLE.match(paper):
        journal, code = _JOURNALS[match["journal"]]
        identifier = _ads_identifier(match, code)
        fields = _dated_fields(match) | declared("miricigale.cli", "papers.toml").get(
            identifier, {}
        )
        fields |= {"journal": journal, "volume": match["volume"], "pages": match["page"]}
        address = identifier.replace("&", "%26")
        fields["adsurl"] = f"https://ui.adsabs.harvard.edu/abs/{address}"
        return "article", fields
    if match := _PREPRINT.match(paper):
        fields = _dated_fields(match)
        fields |= {"eprint": match["number"], "archiveprefix": "arXiv"}
        # arXiv registers a DOI of each preprint
        fields["doi"] = f"10.48550/arXiv.{match['number']}"
        fields["url"] = f"https://arxiv.org/abs/{match['number']}"
        return "misc", fields
    fields = {}
    if match := _PACKAGE.match(paper):
        fields = {"author": "{The miricigale developers}", "title": "miricigale"}
        fields["version"] = match["version"]
    elif match := _DATED.match(paper):
        fields = _dated_fields(match)
    fields["note"] = re.sub(r"([&%#_$])", r"\\\1", work)
    return "misc", fields


def _dated_fields(match):
    """Return the fields of authors and year."""
    authors = match["authors"].replace("et al.", "and others").replace(" & ", " and ")
    return {"author": authors, "year": match["year"]}


def _ads_identifier(match, code):
    """
    Return the identifier of a paper in ADS, of 19 characters.

    Year, journal (5), volume (4), a letter such as that of ApJ Letters or of articles of A&A, page (4), and the
    first author's initial (https://ui.adsabs.harvard.edu/help/actions/bibcode).
    """
    page = match["page"]
    letter = "."
    if page.startswith("L"):
        letter = "L"
        page = page[1:]
    if page.startswith("A"):
        letter = "A"
        page = page[1:]
    if len(page) == 5:
        # the first digit of five stands in the place of the letter
        letter = page[0]
        page = page[1:]
    volume = match["volume"].rjust(4, ".")
    initial = match["authors"][0].upper()
    return match["year"] + code + volume + letter + page.rjust(4, ".") + initial


def _key(work, fields, n_keys):
    """Return the key of an entry, such as yang2021 and yang2021_2."""
    source = fields.get("author", work)
    if "version" in fields:
        # software by its name
        source = fields["title"]
    word = re.match(r"\W*(\w+)", source)[1].lower() + fields.get("year", "")
    n_keys[word] += 1
    if n_keys[word] == 1:
        return word
    return f"{word}_{n_keys[word]}"
