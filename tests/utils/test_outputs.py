"""Files that stand are replaced only if the caller asks for it."""

import inspect
import io
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.nddata import CCDData
from astropy.table import Table

from miricigale.cli.options import read_input
from miricigale.instrument import write_image
from miricigale.pages import Page
from miricigale.utils.outputs import check_output, check_outputs, is_file_name
from miricigale.utils.table_files import write_table


def test_a_file_that_stands_is_replaced_only_if_asked(tmp_path):
    path = tmp_path / "a.fits"
    check_output(path, "output")
    path.write_text("mine")
    with pytest.raises(ValueError, match=r"'output' must be a new file \(or 'overwrite' given\)"):
        check_output(path, "output")
    check_output(path, "output", overwrite=True)
    # by whatever name, an input is never replaced
    (tmp_path / "link.fits").symlink_to(path)
    for name in ("a.fits", "link.fits", "./a.fits"):
        with pytest.raises(ValueError, match="another file than those that are read"):
            check_output(tmp_path / name, "output", overwrite=True, inputs=[f"{path}[1]"])
    with pytest.raises(ValueError, match="a file, got the folder"):
        check_output(tmp_path, "output", overwrite=True)
    with pytest.raises(ValueError, match=r"a table \(\.ecsv, \.csv\)"):
        check_output(path, "output", kind="a table", endings=(".ecsv", ".csv"))
    with pytest.raises(ValueError, match="in a folder that can be written to"):
        check_output("/proc/none/a.fits", "output")


def test_all_files_that_stand_are_named_at_once(tmp_path):
    paths = [tmp_path / name for name in "abc"]
    check_outputs(paths, "folder")
    paths[0].write_text("")
    paths[2].mkdir()
    with pytest.raises(ValueError, match=r"'overwrite' given\), got .*, which has a, c$"):
        check_outputs(paths, "folder")
    check_outputs(paths, "folder", overwrite=True)


@pytest.mark.parametrize(
    "name", ["../a", "/a", "", ".", "..", "a/b", "a\\b", "a\nb", " a", "\ud800"]
)
def test_names_of_files_stay_in_their_folder(name):
    assert not is_file_name(name)


def test_writers_of_single_files_have_one_rule(tmp_path):
    image = CCDData(np.ones((3, 3)), unit="MJy/sr")
    table = Table({"x": [1]})
    writers = {
        "image.fits": lambda path, **options: write_image(image, path, **options),
        "page.html": lambda path, **options: Page("a").write(path, **options),
        "table.fits": lambda path, **options: write_table(table, path, **options),
        "table.ecsv": lambda path, **options: write_table(table, path, **options),
        "table.xml": lambda path, **options: write_table(table, path, **options),
    }
    for name, write in writers.items():
        path = tmp_path / name
        path.write_text("mine")
        with pytest.raises(OSError, match="already exists; overwrite=True replaces it"):
            write(path)
        assert path.read_text() == "mine"
        write(path, overwrite=True)
        assert path.stat().st_size > 4
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(writers)


def test_a_second_input_from_a_pipe_does_not_replace_the_first(tmp_path, monkeypatch):
    def read(text):
        monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(text)))
        return read_input(tmp_path / "fits")

    path = read(b"id,flux\n1,2\n")
    # the same again resumes
    assert read(b"id,flux\n1,2\n") == path == tmp_path / "fits-input.csv"
    with pytest.raises(
        ValueError, match=r"'output' must be another folder, got .* holds another input"
    ):
        read(b"id,flux\n1,3\n")
    assert path.read_bytes() == b"id,flux\n1,2\n"


def test_every_public_writer_can_be_asked_to_overwrite():
    """Public functions and methods that write files, found by their names and arguments."""
    import miricigale

    without = []
    for folder in sorted(Path(miricigale.__file__).parent.glob("*/__init__.pyi")):
        package = __import__(f"miricigale.{folder.parent.name}", fromlist=["_"])
        for name in getattr(package, "__all__", dir(package)):
            part = getattr(package, name)
            functions = {name: part} if inspect.isfunction(part) else {}
            if inspect.isclass(part) and part.__module__.startswith("miricigale"):
                functions = {
                    f"{name}.{key}": value
                    for key, value in vars(part).items()
                    if inspect.isfunction(value)
                }
            for label, function in functions.items():
                last = label.rpartition(".")[2]
                if last.startswith(("write", "save")) and not last.startswith("_"):
                    parameters = inspect.signature(function).parameters
                    # the context of a stage writes into the folder of its run, which is locked and recorded
                    if "overwrite" not in parameters and not label.startswith("Context."):
                        without.append(f"{folder.parent.name}.{label}")
    assert without == []
