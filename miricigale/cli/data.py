"""Commands of what comes with the package and what is added: filters, data."""

import shutil
import sys
import textwrap


def filters(args):
    """List the filters."""
    from astropy.table import unique, vstack

    from miricigale.filters import filter_table

    tables = []
    for pattern in args.pattern or [""]:
        table = filter_table(pattern)
        if len(table) == 0:
            print(f"no filter has {pattern!r} in its name, or at this wavelength", file=sys.stderr)
            return 1
        tables.append(table)
    table = tables[0]
    if len(tables) > 1:
        table = unique(vstack(tables), keys="name")
        table.sort("pivot")
    table.pprint_all()
    return 0


def data_list(args):
    """List reference data."""
    from miricigale.refdata import find_resource, resources

    records = {name: record for name, record in resources().items() if args.pattern in name}
    if not records:
        print(f"no resource has {args.pattern!r} in its name", file=sys.stderr)
        return 1
    width = min(shutil.get_terminal_size((100, 24)).columns, 120)
    for name, record in records.items():
        path = None
        if record.file:
            path = find_resource(name)
        if path is not None:
            state = str(path)
        elif not record.file:
            state = f"read from {record.source}"
        else:
            state = f"absent; miricigale data add {name} PATH"
        print(f"{name} ({record.kind}): {state}")
        lines = [record.title, f"license: {record.licence}", f"cite: {record.citation}"]
        if record.file and path is None:
            lines.append(f"source: {record.source}")
        for line in lines:
            # do not break URLs
            wrapped = textwrap.wrap(line, width - 4, break_long_words=False, break_on_hyphens=False)
            print(textwrap.indent("\n  ".join(wrapped), "    "))
    return 0


def data_check(args):
    """Check reference data."""
    from miricigale.refdata import check_resources

    rows = check_resources()
    length = max(len(row.name) for row in rows)
    for row in rows:
        print(f"{row.name:{length}s}  {row.state:14s}  {row.where}")
        if row.message:
            print(f"{'':{length}s}  {row.message}")
    bad = [row.name for row in rows if row.bad]
    if bad:
        print(f"miricigale: not as they should be: {', '.join(bad)}", file=sys.stderr)
    return int(bool(bad))


def data_add(args):
    """Add a library of reference data."""
    from miricigale.refdata.libraries import add_library

    print(add_library(args.name, args.path, progress_bar=sys.stderr.isatty()))
    return 0
