"""Tables in text files and others that astropy reads by itself, with ids as they stand there."""

import json
import math
import os
import re
import warnings
from pathlib import Path

import numpy as np
from astropy.io import votable
from astropy.io.ascii import convert_numpy
from astropy.table import Column, MaskedColumn, Table
from astropy.utils.exceptions import AstropyWarning

from miricigale.utils.exceptions import CatalogWarning, warn
from miricigale.utils.files import has_match, is_zip, packed_open
from miricigale.utils.fits_tables import check_names_differ
from miricigale.utils.ids import WRITTEN_INDEX, ids_of_text, is_id_name, is_written_index
from miricigale.utils.missing_values import between_missing, is_missing_word
from miricigale.utils.region_files import region_table
from miricigale.utils.text_tables import (
    commas_for_tabs,
    csv_layout,
    names_in_comments,
    plain_rows,
    without_comments,
)

_PIECE = 1 << 20
BOM = b"\xef\xbb\xbf"
#: Numbers that a reader of integers would not give back as they are written: 0007, +7.
_ODD_NUMBER = re.compile(rb"(?:^|[\s,;|&\"'])(?:[+-]?0[0-9]|\+[0-9])")
_DS9 = re.compile(rb"# *Region file format: *DS9|^(?:global |fk5|icrs|image)\b", re.IGNORECASE)


def read_text(path, form, id_names):
    """Table of a text file or another one that astropy reads by itself."""
    if form.startswith("ascii"):
        return _read_ascii(path, form, id_names)
    if is_zip(path):
        msg = f"of {form} in a zip archive: unpack it first"
        raise ValueError(msg)
    if form == "votable":
        return _read_votable(path)
    return Table.read(path, format=form)


def _read_ascii(path, form, id_names):
    """Table of columns of text, in one of astropy's formats ``ascii.*``."""
    start = first_bytes(path)
    if _DS9.search(start[:_PIECE]):
        return region_table(path)
    if start.lstrip()[:1] in (b"{", b"["):
        raise ValueError("it is JSON, and wanted are columns of text")
    source = str(path)
    options = {"format": form}
    if form == "ascii.no_header":
        options["names"] = names_in_comments(start.decode("utf-8", "replace"))
    n_comments = 0
    if form == "ascii.csv":
        options["delimiter"], n_comments = csv_layout(path)
    if n_comments or start.startswith(BOM) or is_zip(path):
        # a mark at the start is no part of the first name, and of archives astropy reads no text
        with packed_open(path) as stream:
            source = stream.read().decode("utf-8-sig").splitlines()[n_comments:]
    units = {}
    if form == "ascii.csv":
        source = without_comments(source, path, options["delimiter"])
        source, units = plain_rows(source, path, options["delimiter"])
        if options["delimiter"] == "\t":
            source = commas_for_tabs(source, path)
            options["delimiter"] = ","
    with warnings.catch_warnings():
        # what 64 bits do not hold is read as text
        warnings.filterwarnings("ignore", "OverflowError converting to IntType", AstropyWarning)
        table = Table.read(source, **options)
    if form == "ascii.ecsv":
        # which states types and units itself
        return table
    for name, unit in units.items():
        table[name].unit = unit
    id_columns = [name for name in table.colnames if name in id_names or is_id_name(name)]
    if WRITTEN_INDEX in table.colnames:
        id_columns.append(WRITTEN_INDEX)
    _numbers_among_words(table, id_columns)
    _ids_as_written(table, path, source, options, id_columns)
    _unmark_first_name(table)
    if table.colnames:
        first = table.colnames[0]
        if is_written_index(first, table.colnames, table[first]):
            table.rename_column(first, "id")
    return table


def _read_votable(path):
    """Table of a VOTable that has one."""
    document = votable.parse(path)
    _check_status(document, path)
    tables = list(document.iter_tables())
    if len(tables) > 1:
        names = ", ".join(str(table.name or table.ID or i) for i, table in enumerate(tables))
        msg = f"it has {len(tables)} tables ({names}): write one of them to a file of its own"
        raise ValueError(msg)
    if len(tables) == 1:
        check_names_differ([field.name for field in tables[0].fields])
    # names are what users see; astropy takes the IDs of fields
    table = Table.read(document, format="votable", use_names_over_ids=True)
    table.meta.update(_own_meta(tables))
    return table


def _own_meta(tables):
    """The meta dictionary that the package wrote into a VOTable; empty for others."""
    for parameter in tables[0].params if tables else ():
        if parameter.name == "META":
            try:
                return dict(json.loads(str(parameter.value)))
            except ValueError:
                break
    return {}


def _check_status(document, path):
    """Refuse a VOTable in which a service reports an error, and warn of one that it cut off."""
    for resource in document.resources:
        for info in document.infos + resource.infos:
            if str(info.name).upper() != "QUERY_STATUS":
                continue
            status = str(info.value).upper()
            if status == "ERROR":
                msg = f"the service that wrote it reports an error: {info.content or 'no reason'}"
                raise ValueError(msg)
            if status == "OVERFLOW":
                text = (
                    "the service that wrote it cut it off (QUERY_STATUS OVERFLOW): rows are missing"
                )
                warn(f"{Path(path).name}: {text}", CatalogWarning)


def _unmark_first_name(table):
    """Take the mark of a comment off the first name: a line "#id,f,e" names columns, as many programs write it."""
    if not table.colnames:
        return
    first = table.colnames[0]
    stem = first.lstrip("# ")
    if first.startswith("#") and stem and stem not in table.colnames:
        table.rename_column(first, stem)


def _numbers_among_words(table, id_names):
    """Turn text into numbers where all but words for a missing value are numbers."""
    for name in table.colnames:
        if table[name].dtype.kind != "U" or name in id_names:
            continue
        column = MaskedColumn(table[name])
        texts = np.char.strip(np.asarray(column))
        missing = column.mask | is_missing_word(texts)
        if not missing.any() or missing.all():
            continue
        try:
            numbers = texts[~missing].astype(float)
        except ValueError:
            continue
        values = between_missing(numbers, missing)
        table[name] = MaskedColumn(values, mask=missing, unit=column.unit)


def _ids_as_written(table, path, source, layout, names):
    """Put the ids of a text file in place that stand there, 0007 or 18446744073709551615."""
    for name in names:
        column = MaskedColumn(table[name])
        if column.dtype.kind in "iu" and not has_match(path, _ODD_NUMBER, overlap=4):
            continue
        if column.dtype.kind == "U":
            texts = np.asarray(column)
        else:
            options = {"converters": {name: [convert_numpy(str)]}, "include_names": [name]}
            if layout["format"] != "ascii.sextractor":
                options["fast_reader"] = False
            texts = Table.read(source, **layout, **options)[name]
            texts = np.asarray(texts).astype(str)
        texts = np.char.strip(texts)
        missing = column.mask | is_missing_word(texts)
        ids = ids_of_text(texts[~missing].tolist())
        if ids.dtype.kind == "U":
            # a word may be an id among text
            missing = column.mask | (texts == "")
            ids = texts[~missing]
        texts_as_numbers = between_missing(ids, missing)
        if missing.any():
            table[name] = MaskedColumn(texts_as_numbers, mask=missing)
        else:
            table[name] = Column(texts_as_numbers)


def first_bytes(path):
    """First bytes of a file, unpacked."""
    with packed_open(path) as stream:
        return stream.read(1 << 16)


def check_text(path):
    """Refuse text in UTF-16, and text that would take far more memory than the file has bytes."""
    size = os.stat(path).st_size
    with open(path, "rb") as stream:
        head = stream.read(_PIECE)
        # as spreadsheets call "Unicode text"
        if head.startswith((b"\xff\xfe", b"\xfe\xff")):
            raise ValueError("it is text in UTF-16: save it in UTF-8")
        # arrays of columns in ECSV: each number takes a byte or more
        for shape in re.findall(rb"subtype: *'?\w+\[([\d, null]*)\]", head):
            if math.prod(map(int, re.findall(rb"\d+", shape))) > size:
                msg = f"it declares arrays of {shape.decode()} numbers, and has {size} bytes"
                raise ValueError(msg)
        while len(head) == _PIECE:
            # a cell makes its whole column as wide
            if b"\n" not in head and b"\r" not in head:
                msg = f"a line is longer than {_PIECE} bytes"
                raise ValueError(msg)
            head = stream.read(_PIECE)
