import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.wcs import WCS

from miricigale.refdata import locate
from miricigale.utils.exceptions import ConfigError, DataError, MiricigaleWarning
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.products import ProductStore, read_image, write_image
from miricigale.workflow.runner import Stage, StudyRunner, check_disk
from miricigale.workflow.stages import study_stages


class Recorder:
    """Two stages that write text and note that they ran."""

    def __init__(self, fail_at=None):
        self.ran = []
        self.fail_at = fail_at

    def first(self, context, unit):
        self.ran.append(f"first:{unit}")
        if self.fail_at == unit:
            raise KeyboardInterrupt
        context.save(f"first_{unit}.txt", lambda path: path.write_text(f"{context.seed} {unit}"))

    def second(self, context, unit):
        self.ran.append("second")
        text = "".join(context.path(f"first_{k}.txt").read_text() for k in "ab")
        context.save("second.txt", lambda path: path.write_text(text))

    def stages(self, version=1):
        return (
            Stage(
                "first",
                self.first,
                "first",
                sections=("scene",),
                units=lambda _: "ab",
                version=version,
            ),
            Stage("second", self.second, "second", needs=("first",)),
        )

    def run(self, folder, config=None, **kwargs):
        self.ran.clear()
        StudyRunner(config or StudyConfig(), folder, self.stages(**kwargs)).run()
        return list(self.ran)


def test_a_second_run_does_nothing(tmp_path):
    recorder = Recorder()
    assert recorder.run(tmp_path / "run") == ["first:a", "first:b", "second"]
    assert recorder.run(tmp_path / "run") == []


def test_an_interrupted_run_goes_on_where_it_was(tmp_path):
    recorder = Recorder(fail_at="b")
    with pytest.raises(KeyboardInterrupt):
        recorder.run(tmp_path / "run")
    recorder.fail_at = None
    assert recorder.run(tmp_path / "run") == ["first:b", "second"]
    assert not (tmp_path / "run" / "run.lock").exists()


def test_only_what_depends_on_a_change_is_done_again(tmp_path):
    recorder = Recorder()
    recorder.run(tmp_path / "run")
    other = StudyConfig.from_dict({"fit": {"model_error": 0.2}})
    assert recorder.run(tmp_path / "run", other) == []
    # the second stage's input did not change although the first was done again
    other = StudyConfig.from_dict({"scene": {"background_scale": 2.0}})
    assert recorder.run(tmp_path / "run", other) == ["first:a", "first:b"]
    other = StudyConfig.from_dict({"run": {"seed": 7}})
    assert recorder.run(tmp_path / "run", other) == ["first:a", "first:b", "second"]
    assert recorder.run(tmp_path / "run", other, version=2) == ["first:a", "first:b"]


def test_a_change_of_the_packages_own_plan_is_seen(tmp_path):
    ran = []

    def function(context, _):
        ran.append(1)
        context.save("x.txt", lambda path: path.write_text("x"))

    for groups in (200, 200, 100):
        stage = Stage("one", function, "one", plan=lambda _, __, n=groups: {"n_groups": n})
        StudyRunner(StudyConfig(), tmp_path / "run", [stage]).run()
    assert len(ran) == 2


def test_other_reference_data_make_other_exposures(tmp_path, monkeypatch):
    # what residual = "etc" means stands in a file, not in the configuration
    class Nothing:
        def checksums(self, name):
            return {}

    def digests():
        stages = [s for s in study_stages() if s.name in ("exposures", "points", "kernels")]
        runner = StudyRunner(StudyConfig(), tmp_path / "run", study_stages())
        units = [next(iter(stage.units(runner.config))) for stage in stages]
        return {
            stage.name: runner.digest(stage, unit, Nothing())
            for stage, unit in zip(stages, units, strict=True)
        }

    monkeypatch.delenv("MIRICIGALE_DATA", raising=False)
    before = digests()
    text = locate("instrument.etc").read_text()
    other = tmp_path / "data" / "instrument" / "etc.toml"
    other.parent.mkdir(parents=True)
    other.write_text(text.replace("f770w = ", "f770w = 2.0  # "))
    monkeypatch.setenv("MIRICIGALE_DATA", str(tmp_path / "data"))
    with pytest.warns(MiricigaleWarning, match="differs from the bundled file"):
        after = digests()
    changed = {name for name in before if after[name] != before[name]}
    assert changed == {"exposures", "points"}


def test_a_damaged_product_is_made_again(tmp_path):
    recorder = Recorder()
    recorder.run(tmp_path / "run")
    path = tmp_path / "run" / "first_a.txt"
    path.write_text(path.read_text().replace("a", "x"))
    assert recorder.run(tmp_path / "run") == ["first:a"]


def test_a_foreign_folder_is_refused(tmp_path):
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(DataError, match="is no run's folder"):
        ProductStore(tmp_path)


def test_a_run_that_was_killed_at_once_can_begin_again(tmp_path):
    (tmp_path / "run.lock").write_text("999999999")
    (tmp_path / ".partial-manifest.json").write_text("{")
    with ProductStore(tmp_path) as store:
        assert store.records == {}


@pytest.mark.parametrize("text", ["[]", "{", '{"stages": {"catalog": {}}}', '{"stages": [1]}'])
def test_a_damaged_manifest_is_named(tmp_path, text):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(DataError, match=r"manifest\.json is not the manifest of a run"):
        ProductStore(tmp_path)


def test_products_that_no_longer_belong_are_removed(tmp_path):
    def function(context, unit):
        context.save(f"{unit}.txt", lambda path: path.write_text(unit))

    for units in ("ab", "a"):
        stage = Stage("one", function, "one", units=lambda _, u=units: u)
        StudyRunner(StudyConfig(), tmp_path / "run", [stage]).run()
    assert (tmp_path / "run" / "a.txt").exists()
    assert not (tmp_path / "run" / "b.txt").exists()


def test_a_stage_that_reads_what_it_has_not_declared_is_an_error(tmp_path):
    stage = Stage("one", lambda context, _: context.config.scene, "one", sections=("run.name",))
    with pytest.raises(RuntimeError, match=r"stage 'one' reads \[scene\] without declaring it"):
        StudyRunner(StudyConfig(), tmp_path / "run", [stage]).run()
    stage = Stage(
        "one", lambda context, _: context.config.run.keep_level1b, "one", sections=("run.name",)
    )
    with pytest.raises(AttributeError, match="keep_level1b"):
        StudyRunner(StudyConfig(), tmp_path / "run", [stage]).run()


def test_a_folder_in_use_is_refused_and_a_stale_lock_is_not(tmp_path):
    import os

    with ProductStore(tmp_path / "run"), pytest.raises(DataError, match="is in use by process"):
        ProductStore(tmp_path / "run").__enter__()
    (tmp_path / "run" / "run.lock").write_text("999999999")
    with ProductStore(tmp_path / "run"):
        assert (tmp_path / "run" / "run.lock").read_text() == str(os.getpid())


def test_stages_must_come_after_what_they_need(tmp_path):
    stage = Stage("second", print, "second", needs=("first",))
    with pytest.raises(ConfigError, match="stage 'second' needs"):
        StudyRunner(StudyConfig(), tmp_path, [stage])


def test_images_survive_the_file(tmp_path):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [53.1, -27.8]
    wcs.wcs.crpix = [3, 2]
    wcs.wcs.cdelt = [-3e-5, 3e-5]
    data = np.arange(12.0, dtype=np.float32).reshape(3, 4)
    meta = {
        "filter": "miri.f770w",
        "exposure time": 5.5,
        "a_long_name_of_a_list": [1, 2],
        "none": None,
    }
    image = CCDData(
        data,
        unit=u.MJy / u.sr,
        wcs=wcs,
        mask=data > 10,
        uncertainty=StdDevUncertainty(data + 1),
        meta=meta,
    )
    write_image(image, tmp_path / "image.fits", planes={"weight": data * 2})
    back, weight = read_image(tmp_path / "image.fits", planes=["weight"])
    assert back.unit == u.MJy / u.sr
    assert dict(back.meta) == meta
    np.testing.assert_array_equal(back.data, data)
    np.testing.assert_array_equal(back.mask, data > 10)
    np.testing.assert_array_equal(back.uncertainty.array, data + 1)
    np.testing.assert_array_equal(weight, data * 2)
    assert back.wcs.pixel_to_world(1, 2).separation(wcs.pixel_to_world(1, 2)) < 1e-6 * u.arcsec


def test_missing_and_foreign_images_are_named(tmp_path):
    with pytest.raises(DataError, match=r"absent\.fits cannot be read as an image"):
        read_image(tmp_path / "absent.fits")
    (tmp_path / "text.fits").write_text("no image")
    with pytest.raises(DataError, match=r"text\.fits cannot be read as an image"):
        read_image(tmp_path / "text.fits")


def test_a_full_disk_is_told_before_the_run(tmp_path):
    with pytest.raises(DataError, match="the run needs about"):
        check_disk(tmp_path / "not" / "yet", 10**18)
    check_disk(tmp_path / "not" / "yet", 1)
