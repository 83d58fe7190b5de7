"""Our ramp fit and calwebb_detector1 on one full frame: slopes, errors and jumps."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits

from miricigale.detector import CosmicRays, Detector, Ramp
from miricigale.detector.effects.base import Block, stream_key
from miricigale.instrument import DQ, Exposure, field_mask, flat_field, photmjsr
from miricigale.reduction import RampSettings, Reducer

pytest.importorskip("jwst", reason="needs the official pipeline: pip install miricigale[jwst]")
pytestmark = pytest.mark.slow

#: Seed of the exposures of ``observe``.
SEED = 20

#: Sigma of our jumps, from the default on; the pipeline cuts at 4.
THRESHOLDS = (5.0, 4.5, 4.0, 3.75, 3.5)


def hit_charge(exposure, detector):
    """DN that cosmic rays left in each group, (n_int, n_group, ny, nx)."""
    (effect,) = (e for e in detector.effects if isinstance(e, CosmicRays))
    shape = (exposure.n_integrations, exposure.n_groups, *exposure.shape)
    flags, key = np.broadcast_to(np.uint8(0), shape), stream_key(SEED, exposure, "CosmicRays")
    rows = slice(0, exposure.shape[0])
    where, electrons = effect.hits(Block(exposure, detector.properties, rows, None, flags, key))
    charge = np.zeros((shape[0] * shape[1], *shape[2:]), np.float32)
    np.add.at(charge, tuple(where), electrons / detector.properties.gain)
    return charge.reshape(shape)


def visibility(v, s, n_diff, n_int):
    """Expected significance of a jump of 1 DN in each difference, by dense linear algebra."""
    covariance = (v + 2 * s) * np.eye(n_diff) - s * (np.eye(n_diff, k=1) + np.eye(n_diff, k=-1))
    inverse = np.linalg.inv(covariance)
    weight = inverse.sum(axis=1)
    return np.sqrt(np.diag(inverse) - weight**2 / (weight.sum() * n_int))


def cut_groups(fit, reducer, shape):
    """Groups that our fit cut: its jumps, and those beside large ones, without what leaked into these."""
    significance = np.zeros(shape, np.float32)
    jumps = fit.jumps
    where = tuple(jumps[name] for name in ("integration", "group", "y", "x"))
    significance[where] = np.abs(jumps["significance"])
    padded = np.pad(significance, ((0, 0), (0, 0), (1, 1), (1, 1)))
    k, g, y, x = where
    sides = ((0, 1), (2, 1), (1, 0), (1, 2))
    leaked = sum(padded[k, g, y + dy, x + dx] for dy, dx in sides)
    large = significance[where] - 0.05 * leaked >= reducer.ramps.neighbor_threshold
    cut = padded > 0
    for dy, dx in sides:
        cut[k[large], g[large], y[large] + dy, x[large] + dx] = True
    return cut[:, :, 1:-1, 1:-1]


@pytest.mark.parametrize(
    ("band", "n_groups", "n_integrations", "flux"),
    [("miri.f770w", 40, 2, 200.0), ("miri.f2100w", 12, 6, 2000.0)],
)
def test_full_frame(tmp_path, tools, band, n_groups, n_integrations, flux):
    mode = {"n_groups": n_groups, "n_integrations": n_integrations}
    exposure = Exposure(band, pointing=tools.POINTING, roll=110 * u.deg, **mode)
    x, y = (g.ravel() for g in np.meshgrid(430 + 85.3 * np.arange(7), 70 + 98.4 * np.arange(10)))
    catalog = tools.star_field(exposure, x, y, np.full(x.size, flux))
    crds = tools.make_crds(tmp_path / "crds", "--filters", band, "--groups", str(n_groups))
    (seen,) = tools.observe([exposure], catalog, tmp_path)
    tools.run_stage("detector1+ramp", tmp_path, [seen.uncal], crds)
    with fits.open(seen.product(tmp_path, "rate")) as hdus:
        rate, error = (hdus[name].data.astype(float) for name in ("SCI", "ERR"))
        dq = hdus["DQ"].data
    with fits.open(seen.product(tmp_path, "ramp")) as hdus:
        official = (hdus["GROUPDQ"].data & int(DQ.JUMP_DET)) != 0
    # the groups and the correction by reference pixels that the pipeline has, and the default thresholds
    reducer = Reducer(skip_last=1, ramps=RampSettings(reference_correction="channels"))
    ramp = Ramp.read(seen.uncal)
    fit = reducer.fit_groups(ramp)
    detector = Detector.miri_imager()
    properties, field = detector.properties, field_mask()
    dark = properties.dark_current / properties.gain
    truth = seen.light * flat_field(band) / photmjsr(band)

    both = field & (dq == 0) & (fit.flags == 0)
    assert both.sum() > 0.8 * field.sum()
    assert np.std(((fit.rate - rate) / fit.error)[both]) < 0.1
    ours = np.std(((fit.rate - truth) / fit.error)[both])
    theirs = np.std(((rate - truth) / error)[both])
    assert ours == pytest.approx(1, abs=0.01)
    assert abs(ours - 1) <= abs(theirs - 1)

    # jumps that stand above 5 sigma in the noise of their pixel, and groups that hold any charge
    charge = hit_charge(exposure, detector)
    step = exposure.group_time.to_value("s")
    v = (truth + dark) * step / properties.gain * float(np.sum(properties.ipc_kernel**2))
    s = properties.read_noise**2 + 1 / 12
    levels = np.unique(np.quantile(v[field], [0, 0.01, 0.5, 0.9, 0.99, 0.999, 1]))
    seen_by = np.array([visibility(level, s, n_groups - 2, n_integrations) for level in levels])
    good = field & ((fit.flags | dq) & int(DQ.DO_NOT_USE | DQ.SATURATED) == 0)
    # both as curves of the threshold: no choice of ours decides
    cuts = [official & good]
    for threshold in THRESHOLDS:
        other = reducer.replace(jump_threshold=threshold)
        cuts.append(cut_groups(other.fit_groups(ramp), other, charge.shape) & good)
    found, real, flagged = np.zeros((3, len(cuts)))
    n_jumps = 0
    for g in range(1, n_groups - 1):
        significance = charge[:, g] * np.interp(v, levels, seen_by[:, g - 1]) * good
        jumps = significance > 5
        n_jumps += np.count_nonzero(jumps)
        for i, cut in enumerate(cuts):
            found[i] += np.count_nonzero(cut[:, g] & jumps)
            real[i] += np.count_nonzero(cut[:, g] & (charge[:, g] > 0))
            flagged[i] += np.count_nonzero(cut[:, g])
    (recall, *recalls), (precision, *precisions) = found / n_jumps, real / flagged
    assert n_jumps > 10_000
    # thresholds fall, so that recall grows and precision falls
    at_its_precision = np.interp(precision, precisions[::-1], recalls[::-1])
    at_its_recall = np.interp(recall, recalls, precisions)
    table = f"{recall} {precision}; {recalls} {precisions}"
    assert at_its_precision >= recall, table
    assert at_its_recall >= precision, table
