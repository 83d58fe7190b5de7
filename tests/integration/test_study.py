"""The whole study at a small size: every stage, resume after a stop, the command line."""

import collections
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

from miricigale.depth import saturation_forecast
from miricigale.instrument import DQ
from miricigale.instrument.image_files import read_image
from miricigale.workflow import disk_use, load_config, study_stages
from miricigale.workflow.stages.exposures import study_exposures

pytestmark = pytest.mark.slow

SMALL = Path(__file__).with_name("small.toml")


def recorded(folder, name):
    """Whether a product is in the manifest: it is whole, and so is all that was made with it."""
    paths = [folder / "small" / file for file in ("manifest.json", ".manifest.journal")]
    return any(path.is_file() and f'"{name}"' in path.read_text() for path in paths)


def stopped(command, folder, name, how):
    """Start a run, stop it by a signal once a product is recorded; exit status and messages."""
    process = subprocess.Popen(
        command,
        cwd=folder,
        stderr=subprocess.PIPE,
        text=True,
        # whoever runs the tests in the background hands down an ignored SIGINT
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 1200
    while not recorded(folder, name) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(how)
    _, message = process.communicate(timeout=120)
    return process.returncode, message


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Folder of a small study that was killed, then stopped, then finished."""
    folder = tmp_path_factory.mktemp("study")
    shutil.copy(SMALL, folder)
    command = [sys.executable, "-m", "miricigale", "run", "small.toml", "--no-progress"]
    name = "agn00/exposures/miri.f770w-0_cal.fits"
    product = folder / "small" / name
    # without other processes, which each import the package
    killed = stopped([*command, "--threads", "1"], folder, name, signal.SIGKILL)
    before = product.stat().st_mtime_ns
    terminated = stopped(command, folder, "agn00/photometry/miri.f770w.ecsv", signal.SIGTERM)
    locked = (folder / "small" / "run.lock").exists()
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    stopped_by = {"killed": killed, "terminated": terminated}
    times = {"before": before, "after": product.stat().st_mtime_ns}
    return {"folder": folder / "small", "locked": locked, "done": done} | stopped_by | times


def test_a_killed_and_a_stopped_run_go_on(study):
    assert study["killed"][0] == -signal.SIGKILL
    status, message = study["terminated"]
    assert status == 128 + signal.SIGTERM
    assert "the same command resumes here" in message
    assert not study["locked"]
    assert study["done"].returncode == 0, study["done"].stderr
    assert study["done"].stdout.strip().endswith("report/index.html")
    assert study["before"] == study["after"]
    assert not list(study["folder"].rglob(".partial-*"))
    assert not (study["folder"] / "run.lock").exists()


def test_every_product_stands_in_the_manifest_and_nothing_else(study):
    manifest = json.loads((study["folder"] / "manifest.json").read_text())
    recorded = {name for record in manifest["stages"].values() for name in record["products"]}
    found = {str(p.relative_to(study["folder"])) for p in study["folder"].rglob("*") if p.is_file()}
    assert found - recorded == {".run.lock", "manifest.json", ".manifest.copy.json", "config.toml"}
    assert recorded - found == set()


def test_deleted_products_make_only_themselves_anew_with_the_same_bytes(study):
    folder = study["folder"]

    def contents():
        return {
            str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
            for path in folder.rglob("*")
            if path.is_file() and "manifest" not in path.name and path.name != ".run.lock"
        }

    before = contents()
    deleted = {
        "input_seds.fits",
        "agn00/exposures/miri.f1500w-0_forecast.ecsv",
        "kernel_miri.f770w.fits",
        "agn00/mosaic_miri.f1500w.fits",
        "agn00/photometry/miri.f770w.ecsv",
        "agn00/fits_none.ecsv",
    }
    for name in deleted:
        (folder / name).unlink()
    command = [sys.executable, "-m", "miricigale", "run", "small.toml", "--threads", "1"]
    done = subprocess.run(
        command, cwd=folder.parent, capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr
    # a line for each stage, and none that rewrites itself
    assert "6 of 22 steps to do" in done.stderr
    assert "mosaic (2): " in done.stderr
    assert "\r" not in done.stderr
    assert "\x1b" not in done.stderr
    after = contents()
    assert {name: data for name, (_, data) in after.items()} == {
        name: data for name, (_, data) in before.items()
    }
    manifest = json.loads((folder / "manifest.json").read_text())
    units = [
        set(r["products"]) for r in manifest["stages"].values() if deleted & set(r["products"])
    ]
    changed = {name for name, (time_ns, _) in after.items() if time_ns != before[name][0]}
    assert changed == set().union(*units)


def test_no_source_is_lost_between_catalogue_and_result(study):
    catalog = QTable.read(study["folder"] / "catalog.ecsv")
    truth = QTable.read(study["folder"] / "agn00" / "truth.ecsv")
    matched = QTable.read(study["folder"] / "agn00" / "matched.ecsv")
    assert truth["id"].tolist() == catalog["id"].tolist() == matched["id"].tolist()
    fitted = QTable.read(study["folder"] / "agn00" / "fits_all.ecsv")
    sample = matched["id"][np.asarray(matched["selection"]) == 0]
    assert fitted["id"].tolist() == sample.tolist()


def test_point_sources_come_back_as_they_went_in(study):
    for name in ("miri.f770w", "miri.f1500w"):
        table = QTable.read(study["folder"] / "points" / f"{name}.ecsv")
        table = table[np.asarray(table["in_field"])]
        ratio = (table["flux"] / table["flux_true"]).to_value(u.one)
        assert len(ratio) > 20
        assert np.isfinite(ratio).all()
        # the promise of the study: 3 % in the median
        assert abs(np.median(ratio) - 1) < 0.03
        # images and PSFs are of one calibration, so that the paper's factor is 1
        meta = QTable.read(study["folder"] / "points" / f"{name}.ecsv").meta
        assert abs(meta["f_scaling"] - 1) < 0.02
        assert 1.05 < meta["f_aper"] < 1.25


def test_the_mosaic_shows_the_truth(study):
    """Measured light of bright stars against the injected flux."""
    truth = QTable.read(study["folder"] / "agn00" / "truth.ecsv")
    matched = QTable.read(study["folder"] / "agn00" / "matched.ecsv")
    stars = np.flatnonzero(
        np.asarray(truth["star"], bool)
        & np.asarray(matched["matched"])
        & (truth["miri.f770w"] > 10 * u.uJy)
    )
    ratio = (matched["miri.f770w"][stars] / truth["miri.f770w"][stars]).to_value(u.one)
    assert len(ratio) >= 2
    assert abs(np.median(ratio) - 1) < 0.05


def test_saturation_is_told_before_each_exposure(study):
    units = study_exposures(load_config(study["folder"] / "config.toml"))
    assert len(units) == 3
    for unit, exposure in units.items():
        (told,) = QTable.read(study["folder"] / f"agn00/exposures/{unit}_forecast.ecsv")
        assert (told["filter"], told["dither"]) == (exposure.filter, exposure.dither)
        # the closed form of the low background; gradient and flat field are a few per cent
        assert told["sky_fraction"] == pytest.approx(saturation_forecast(exposure), rel=0.06)
        # and the image has no slope where the well was full from the start
        _, flags = read_image(study["folder"] / f"agn00/exposures/{unit}_cal.fits", planes=["dq"])
        full = np.count_nonzero(flags & DQ.SATURATED)
        assert abs(full - told["n_pixels"]) <= 3 + 0.3 * told["n_pixels"]


def test_the_report_has_its_sections_and_numbers(study):
    # of slopes those that the page shows are kept, and no level 1b
    rates = {path.name for path in study["folder"].rglob("*_rate.fits")}
    assert rates == {"miri.f770w-0_rate.fits", "miri.f1500w-0_rate.fits"}
    assert not list(study["folder"].rglob("*_uncal.fits"))
    page = (study["folder"] / "report" / "index.html").read_text()
    assert "An exposure in F1500W before and after its background was subtracted" in page
    metrics = json.loads((study["folder"] / "report" / "metrics.json").read_text())
    assert metrics["n_sample"] > 10
    assert metrics["fits"]["all"]["n"] == metrics["n_sample"]


#: Forks a run on one thread that keeps its level 1b, for each stage: the process kills itself in the
#: middle of the first file that this stage writes. Pictures of a page of which half a file is written are
#: not drawn; the last run draws them.
KILLER = """
import json, os, signal, sys
from miricigale.pages import page
from miricigale.workflow import StudyRunner, load_config, study_stages
from miricigale.workflow.engine.stage import Context

save = Context.save
study_stages()  # what is imported here is not imported by each fork
config = load_config(sys.argv[1], overrides={"run": {"threads": 1, "keep_level1b": True}})


def run(stage):
    def stopped(context, name, writer):
        def half(path):
            path.write_bytes(b"half of a file")
            os.kill(os.getpid(), signal.SIGKILL)

        return save(context, name, half if context._name == stage else writer)

    Context.save = stopped
    if stage == "report":
        page.image_of = lambda figure, dpi: ("data:,", 1)
    StudyRunner(config, sys.argv[2], study_stages).run()


ends = {}
for stage in [*sys.argv[3:], ""]:
    child = os.fork()
    if child == 0:
        run(stage)
        os._exit(0)
    ends[stage] = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
print(json.dumps(ends))
"""


def test_killed_in_each_stage_on_one_thread_and_with_level1b_it_ends_with_the_same_bytes(
    study, tmp_path
):
    folder = tmp_path / "again"
    known = json.loads((study["folder"] / "manifest.json").read_text())["stages"]
    written = {key.partition(":")[0] for key, record in known.items() if record["products"]}
    assert written >= {
        "catalog", "seds", "truth", "exposures", "mosaics", "highres", "kernels", "templates",
        "photometry", "points", "errors", "matches", "fits", "sources", "report",
    }  # fmt: skip
    order = [stage.name for stage in study_stages() if stage.name in written]
    command = [sys.executable, "-c", KILLER, study["folder"] / "config.toml", folder, *order]
    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, check=False, timeout=900
    )
    ends = json.loads(done.stdout)
    assert ends == dict.fromkeys(order, -signal.SIGKILL) | {"": 0}, done.stderr
    again = json.loads((folder / "manifest.json").read_text())["stages"]
    assert set(again) == set(known)
    for key, record in known.items():
        more = set(again[key]["products"]) - set(record["products"])
        assert all("/level1b/" in name or name.endswith("_rate.fits") for name in more)
        assert record["products"].items() <= again[key]["products"].items()
        for name in record["products"]:
            assert (folder / name).read_bytes() == (study["folder"] / name).read_bytes(), name
    assert not list(folder.rglob(".partial-*"))
    # every exposure has its files, which name themselves
    paths = list((folder / "agn00" / "level1b").iterdir())
    assert len(paths) == len(list(folder.rglob("*_rate.fits"))) == 3
    for path in paths:
        assert fits.getheader(path)["FILENAME"] == path.name


def test_the_forecast_of_the_disk_is_right(study):
    forecast = disk_use(load_config(study["folder"] / "config.toml"))
    taken = sum(path.stat().st_size for path in study["folder"].rglob("*") if path.is_file())
    assert abs(sum(forecast.values()) / taken - 1) < 0.3
    manifest = json.loads((study["folder"] / "manifest.json").read_text())
    sizes = collections.Counter()
    for key, record in manifest["stages"].items():
        sizes[key.partition(":")[0]] += sum(one["bytes"] for one in record["products"].values())
    for name, size in sizes.items():
        if size > 0.1 * taken:
            assert abs(forecast[name] / size - 1) < 0.3, name
