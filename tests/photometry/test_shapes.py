import numpy as np
import pytest
import scipy.ndimage
import scipy.optimize
import scipy.stats
from astropy.nddata import overlap_slices
from numpy.testing import assert_allclose

from helpers.light import gaussian_image
from miricigale.photometry._core.shape_fits import evidence_of
from miricigale.photometry.shapes.population import Population
from miricigale.photometry.shapes.shape_models import ShapeModels
from miricigale.photometry.shapes.shapes import Neighbors, ShapeFitter, normal_nodes
from miricigale.photometry.shapes.template_choice import cutouts
from miricigale.profiles import sersic_image

SCALE = 0.06  # arcsec per pixel
WIDTH = 1.4  # rms width of the PSF in pixels


def gaussian_psf(n=61):
    psf = gaussian_image(n, WIDTH)
    return psf / psf.sum()


def galaxy(shape, x, y, *, r_eff, n, q=1.0, theta=0.0, flux=1.0, fine=5):
    """A Sersic profile through the PSF, by cells five times as small and a Gaussian filter."""
    ny, nx = shape
    image = sersic_image(
        (ny * fine, nx * fine), x=fine * x + fine // 2, y=fine * y + fine // 2,
        total_flux=flux, r_eff=fine * r_eff, n=n, axis_ratio=q, theta=theta,
    )  # fmt: skip
    # the cells have a width of their own
    width = np.sqrt((fine * WIDTH) ** 2 - 1 / 12)
    image = scipy.ndimage.gaussian_filter(image, width, truncate=7, mode="constant")
    return image[fine // 2 :: fine, fine // 2 :: fine] * fine**2


@pytest.mark.parametrize(("n", "r_eff", "q"), [(1.0, 3.0, 0.5), (2.5, 2.0, 0.8), (4.0, 3.0, 0.6)])
def test_models_are_those_of_the_renderer(n, r_eff, q):
    truth = galaxy((41, 41), 20.3, 19.6, r_eff=r_eff, n=n, q=q, theta=0.5)
    eta = -np.log(q)
    parameters = [
        20.3, 19.6, np.log(r_eff * np.sqrt(q)), np.log(n), eta * np.cos(1.0), eta * np.sin(1.0),
    ]  # fmt: skip
    # a large period, for the wings of its images not to matter
    image = ShapeModels(gaussian_psf()).profiles((161, 161), parameters)[0, :41, :41]
    assert_allclose(image, truth, atol=1e-3 * truth.max())


def test_gaussian_profile_is_as_wide_as_both():
    """The profile of index 0.5 is a Gaussian, half of whose light is within sqrt(2 ln 2) widths."""
    radius, ratio, angle = 4.0, 0.6, 0.7
    eta = -np.log(ratio)
    ellipticity = eta * np.cos(2 * angle), eta * np.sin(2 * angle)
    parameters = [24.3, 23.8, np.log(radius), np.log(0.5), *ellipticity]
    image = ShapeModels(gaussian_psf()).profiles((49, 49), parameters)[0]
    axes = radius**2 / (2 * np.log(2)) * np.array([1 / ratio, ratio]) + WIDTH**2
    y, x = np.indices((49, 49)) - np.array([23.8, 24.3])[:, None, None]
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    truth = np.exp(-0.5 * (along**2 / axes[0] + across**2 / axes[1]))
    truth /= 2 * np.pi * np.sqrt(axes.prod())
    assert_allclose(image, truth, atol=1e-3 * truth.max())
    assert_allclose(image.sum(), truth.sum(), rtol=1e-3)


@pytest.mark.parametrize("ellipticity", [(0.4, -0.3), (1e-5, 0.0)])
def test_derivatives(ellipticity):
    models = ShapeModels(gaussian_psf())
    parameters = np.array([15.3, 16.2, np.log(3.0), np.log(1.7), *ellipticity])
    images = models.profiles((33, 33), parameters, 6)
    assert images.shape == (7, 33, 33)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 2e-2
        high, low = (models.profiles((33, 33), parameters + s)[0] for s in (step, -step))
        assert_allclose(images[1 + k], (high - low) / 4e-2, atol=5e-3 * np.abs(images[1 + k]).max())


@pytest.mark.parametrize(("n", "r_eff", "q"), [(0.7, 4.0, 0.4), (1.0, 2.0, 0.9), (3.0, 5.0, 0.6)])
def test_noiseless_galaxies_are_recovered(n, r_eff, q):
    shape = (97, 97)
    data = galaxy(shape, 48.2, 47.7, r_eff=r_eff, n=n, q=q, theta=2.0, flux=7.0)
    weight = np.full(shape, 1e5)
    # a neighbour's pixels do not count
    data[60:, 50:70] += 0.1
    weight[60:, 50:70] = 0.0
    shape = ShapeFitter(gaussian_psf(), SCALE).fit(data, weight, (48.0, 48.0))
    radius, ratio, angle = shape.axes
    assert_allclose(shape.flux, 7.0, rtol=0.01)
    assert_allclose([radius, ratio], [r_eff, q], rtol=0.01)
    assert_allclose(np.exp(shape.parameters[3]), n, rtol=0.02)
    assert_allclose(angle % np.pi, 2.0, atol=0.01)
    assert_allclose(shape.parameters[:2], [48.2, 47.7], atol=0.01)
    assert shape.point < 1e-6


def test_galaxies_that_overlap_are_recovered_together():
    size = (97, 97)
    wide, small = {"r_eff": 5.0, "n": 1.5, "q": 0.7}, {"r_eff": 2.0, "n": 1.0, "q": 0.8}
    light = 7.0, 2.0
    centers = np.array([(44.2, 47.7), (53.1, 49.2)])
    images = [
        galaxy(size, *xy, flux=flux, **one)
        for xy, flux, one in zip(centers, light, (wide, small), strict=True)
    ]
    fitter = ShapeFitter(gaussian_psf(), SCALE)
    weight = np.full(size, 1e4)
    # each on its own side, with the light of both
    sides = np.arange(size[1]) < 49, np.arange(size[1]) > 49
    drafts = [
        fitter.fit(sum(images), weight * side, xy) for xy, side in zip(centers, sides, strict=True)
    ]
    assert abs(drafts[1].flux / light[1] - 1) > 0.3
    known = np.round(centers), [fitter.expected] * 2
    found, _ = fitter.fit_together(sum(images), weight, *known, drafts)
    for one, flux, xy, true in zip(found, light, centers, (wide, small), strict=True):
        radius, ratio, _ = one.axes
        assert_allclose([one.flux, radius, ratio], [flux, true["r_eff"], true["q"]], rtol=0.01)
        assert_allclose(np.exp(one.parameters[3]), true["n"], rtol=0.01)
        assert_allclose(one.parameters[:2], xy, atol=0.01)
    # the light of one is less well known if the other may change: by draws of the noise, and as stated
    weight, rng = np.full(size, 500.0), np.random.default_rng(1)
    drawn, stated = [], []
    for _ in range(40):
        noise = rng.normal(size=size) / weight
        both, beside = fitter.fit_together(sum(images) + noise, weight, *known, found)
        other = both[0].flux * fitter.profiles(size, both[0].parameters)[0]
        data = sum(images) + noise - other
        again = (
            fitter.fit(data, weight, centers[1], start=both[1], neighbors=free)
            for free in (None, beside[1])
        )
        stated.append([np.sqrt(one.covariance[0, 0]) for one in again])
        drawn.append(np.log(both[1].flux))
    alone, free = np.mean(stated, axis=0)
    assert free > 1.03 * alone
    assert_allclose(free, np.std(drawn), rtol=0.25)


def test_light_of_a_neighbor_beyond_the_stamp_is_where_it_is():
    """As the renderer has it within 16 pixels of its center; transforms are periodic."""
    fitter, x, y = ShapeFitter(gaussian_psf(), SCALE), 44.3, 14.8
    stamp = fitter._stamp(*np.ones((2, 33, 33)), np.array([[16.0, 16.0]]), 16)
    parameters = np.array([[x, y, np.log(3.0), 0.0, 0.0, 0.0], [x + 60, y, np.log(3.0), 0, 0, 0]])
    found = stamp.changes(Neighbors(np.array([5.0, 5.0]), parameters, np.eye(14)))
    near, far = found.reshape(2, 7, 33, 33)
    truth = galaxy((33, 60), x, y, r_eff=3.0, n=1.0)
    truth[:, : round(x) - 16] = 0.0
    truth[round(y) + 17 :] = 0.0
    assert_allclose(near[0], truth[:, :33], atol=1e-4 * truth.max())
    assert near[0].max() > 2e-3 * truth.max()
    assert not far.any()


def test_evidence_is_the_integral_over_light_and_center():
    fitter, rng = ShapeFitter(gaussian_psf(), SCALE), np.random.default_rng(3)
    truth = np.array([16.2, 15.9, np.log(2.5), 0.0, 0.2, -0.1])
    light = 600 * fitter.profiles((33, 33), truth)[0] + rng.normal(0, 1.0, (33, 33))
    # of a part of the source: the light goes with the center
    weight = np.where(np.arange(33) < 18, 1.0, 0.0) * np.ones((33, 1))
    light *= weight
    stamp = fitter._stamp(light, weight, truth[None], 16)
    mean, width = truth + [0.03, -0.02, 0, 0, 0, 0], 0.05
    best = stamp.minimum(truth[None], mean[None], np.eye(2)[None] / width**2)
    shapes = truth[2:] + [[0, 0, 0, 0], [0.03, -0.02, 0.02, 0.0]]
    prior = mean[None], np.eye(2)[None] / width**2
    none = np.zeros((0, light.size))
    # a prior that is twice as wide about the same values holds a quarter of its density there
    flat = [stamp.minimum(best[2], best[2], np.eye(2)[None] / w**2)[3] for w in (50.0, 100.0)]
    assert_allclose(flat[0] - flat[1], 2 * np.log(2), rtol=1e-4)

    def misfit(offset, shape):
        """Chi^2 with the prior, and the light."""
        model = fitter.profiles((33, 33), [*(mean[:2] + offset), *shape])[0] * weight
        fit = np.sum(model * light) / np.sum(model**2, dtype=float)
        return np.sum((light - fit * model) ** 2) + np.sum(offset**2) / width**2, fit

    # where the center of each shape is best, by another minimizer
    centers = [
        scipy.optimize.minimize(
            lambda offset, shape=shape: misfit(offset, shape)[0], [0.0, 0.0], method="Nelder-Mead"
        ).x
        for shape in shapes
    ]
    drift = mean[:2] + centers - best[2][0, :2]
    found = evidence_of(*stamp.pixels, best[2], best[1], shapes, drift, *prior, none)
    step = 0.008
    grid = np.arange(-0.2, 0.201, step)
    for shape, center, (value, flux) in zip(shapes, centers, found, strict=True):
        total = 0.0
        for dx in grid:
            for dy in grid:
                model = fitter.profiles((33, 33), [*(mean[:2] + [dx, dy]), *shape])[0]
                model = (model * weight).ravel()
                power, seen = model @ model, model @ light.ravel()
                # the light is flat in its logarithm, and well known
                fit = seen / power
                inside = np.exp(-0.5 * (light.ravel() @ light.ravel() - seen * fit - light.size))
                inside *= np.exp(-0.5 * (dx**2 + dy**2) / width**2)
                total += inside / (fit * np.sqrt(power))
        expected = np.log(total * step**2 / (2 * np.pi * width**2)) - 0.5 * light.size
        assert_allclose(value, expected, atol=0.02)
        assert_allclose(flux, np.log(misfit(center, shape)[1]), atol=1e-4)


def test_the_shape_of_a_source_is_the_mean_over_its_nodes():
    """Nodes, their odds and moments in one compiled call, by numpy; light of a given shape has a closed form."""
    fitter, rng = ShapeFitter(gaussian_psf(), SCALE), np.random.default_rng(5)
    truth = np.array([16.2, 15.9, np.log(2.0), 0.1, 0.2, -0.1])
    light = 400 * fitter.profiles((33, 33), truth)[0] + rng.normal(size=(33, 33))
    weight = np.ones((33, 33))
    population = Population.expected(SCALE)
    shape = fitter.fit(light, weight, truth[:2], population)
    best = fitter.fit(light, weight, truth[:2], population, nodes=False)
    # nodes are where a normal distribution, 1.4 times as wide as that of the fit, has them
    covariance = best.covariance[3:, 3:]
    root = 1.4 * np.linalg.cholesky(covariance)
    assert_allclose(shape.nodes[:, 2:], best.parameters[2:] + normal_nodes() @ root.T, rtol=1e-9)
    # likelihoods are over the density that nodes are drawn from
    stamp = fitter._stamp(light, weight, best.parameters[None], 16)
    along = np.linalg.solve(covariance, best.covariance[3:, 1:3])
    drift = (shape.nodes[:, 2:] - best.parameters[2:]) @ along
    mean = np.append(truth[:2], population.mean)
    values = evidence_of(
        *stamp.pixels, best.parameters[None], np.array([best.flux]), shape.nodes[:, 2:].copy(),
        drift, mean[None], np.eye(2)[None] / 0.7**2, np.zeros((0, light.size)),
    )  # fmt: skip
    density = scipy.stats.multivariate_normal(best.parameters[2:], root @ root.T)
    expected = values[:, 0] - density.logpdf(shape.nodes[:, 2:])
    assert_allclose(shape.nodes[:, 0], expected, rtol=1e-9)
    odds, point = population.odds(shape.nodes[None], np.array([shape.as_point]))
    assert_allclose(shape.point, point[0], rtol=1e-9)
    odds = odds[0] / odds[0].sum()
    flux_and_shape = np.append(np.log(shape.flux), shape.parameters[2:])
    assert_allclose(flux_and_shape, odds @ shape.nodes[:, 1:], rtol=1e-9)
    assert_allclose(shape.parameters[:2], best.parameters[:2])
    keep = np.ix_([0, 3, 4, 5, 6], [0, 3, 4, 5, 6])
    moments = np.cov(shape.nodes[:, 1:].T, aweights=odds, bias=True)
    moments[0, 0] += 1 / np.linalg.inv(best.covariance)[0, 0]
    assert_allclose(shape.covariance[keep], moments, rtol=1e-8, atol=1e-12)
    assert_allclose(shape.covariance[1:3, 1:3], best.covariance[1:3, 1:3])


def test_neighbors_that_may_change_take_power_from_the_evidence():
    """At the best light and a fixed center only the error of the light is larger, by what they share of it."""
    fitter, rng = ShapeFitter(gaussian_psf(), SCALE), np.random.default_rng(4)
    truth = np.array([16.2, 15.9, np.log(2.5), 0.0, 0.2, -0.1])
    model = fitter.profiles((33, 33), truth)[0]
    stamp = fitter._stamp(
        90 * model + rng.normal(size=(33, 33)), np.ones((33, 33)), truth[None], 16
    )
    prior = truth[None], 1e12 * np.eye(2)[None]
    _, flux, best, *_ = stamp.minimum(truth[None], *prior)
    beside = 0.02 * rng.normal(size=(3, model.size)) + 0.4 * model.ravel() / np.linalg.norm(model)
    alone, free = (
        evidence_of(*stamp.pixels, best, flux, best[:, 2:], np.zeros((1, 2)), *prior, one)[0]
        for one in (beside[:0], beside)
    )
    power, shared = np.sum(model**2, dtype=float), beside @ model.ravel()
    more = -0.5 * np.log(1 - shared @ shared / power)
    assert more > 0.2
    assert_allclose(free - alone, [more, 0.0], atol=1e-4)


@pytest.mark.parametrize(("snr", "share"), [(8, 0.7), (30, 0.95)])
def test_points_are_told_from_galaxies(snr, share):
    rng = np.random.default_rng(snr)
    fitter = ShapeFitter(gaussian_psf(), SCALE)
    point = gaussian_image(41, WIDTH, 0.2, -0.3)
    wide = galaxy((41, 41), 20.2, 19.7, r_eff=4.0, n=1.0, q=0.7)
    found = {}
    for name, image in (("point", point), ("galaxy", wide)):
        # significance of the best filter
        sigma = np.sqrt(np.sum(image**2)) / snr
        weight = np.full((41, 41), 1 / sigma)
        drawn = (image + rng.normal(0, sigma, image.shape) for _ in range(40))
        fits = [fitter.fit(one, weight, (20, 20)) for one in drawn]
        found[name] = np.mean([one is not None and one.point > 0.5 for one in fits])
    assert found["point"] >= share
    assert found["galaxy"] <= 1 - share


def test_no_light_gives_no_shape():
    hole = -50 * gaussian_image(41, 3.0)
    assert ShapeFitter(gaussian_psf(), SCALE).fit(hole, np.full((41, 41), 50.0), (20, 20)) is None


def cutouts_of(image, sigma, labels, places, *, n_psf=61, min_snr=5.0, **options):
    """Templates of the segments of an image with white noise."""
    fine = image, np.full(image.shape, sigma**2), gaussian_psf(n_psf), SCALE
    numbers, places = np.arange(1, len(places) + 1), np.array(places, float)
    parts, flags, *_ = cutouts(*fine, labels, numbers, places, min_snr=min_snr, **options)
    assert not flags.any()
    return parts


def one_cutout(image, sigma, **options):
    labels = (scipy.ndimage.gaussian_filter(image, 1.5) > 0.6 * sigma).astype(int)
    return cutouts_of(image, sigma, labels, [(40, 40)], **options)[0]


def test_template_is_the_simplest_that_explains_the_image():
    sigma = 0.002
    noise = np.random.default_rng(2).normal(0, sigma, (81, 81))
    assert one_cutout(gaussian_image(81, WIDTH) + noise, sigma) is None
    profile = galaxy((81, 81), 40, 40, r_eff=5.0, n=1.5, q=0.6)
    assert one_cutout(profile + noise, sigma).kind == "sersic"
    # two knots are no profile
    knots = sum(gaussian_image(81, WIDTH, *at) for at in ((-4, 1), (5, -2)))
    knots = 0.6 * profile + 0.2 * knots
    cutout = one_cutout(knots + noise, sigma)
    assert cutout.kind == "cutout"
    # what is asked for is done even if a profile would do
    assert one_cutout(profile + noise, sigma, select=False).kind == "cutout"
    # the light of the parts is that of the whole
    assert_allclose(sum(layer.data.sum() for layer in cutout.layers), 1.0, atol=0.01)


def seen(cutout, shape):
    """The light of a template at the resolution of the image, by plain convolution."""
    image = np.zeros(shape)
    for layer in cutout.layers:
        part = np.zeros(shape)
        middle = np.add(layer.origin, np.divide(layer.data.shape, 2))
        inside, own = overlap_slices(shape, layer.data.shape, middle, mode="trim")
        part[inside] = layer.data[own]
        image += part if layer.convolved else scipy.ndimage.gaussian_filter(part, WIDTH)
    return image


def test_wings_of_a_bulge_and_a_disk_are_what_is_seen():
    """The bulge makes one profile for all far too bright outside."""
    shape, sigma = (161, 161), 2e-5
    truth = 0.5 * galaxy(shape, 80, 80, r_eff=2.5, n=4.0)
    truth += 0.5 * galaxy(shape, 80, 80, r_eff=9.0, n=0.6)
    image = truth + np.random.default_rng(4).normal(0, sigma, shape)
    # a segment that ends where there is much light still
    labels = (truth > 25 * sigma).astype(int)
    (cutout,) = cutouts_of(image, sigma, labels, [(80, 80)])
    assert cutout.kind == "cutout"
    radius = np.hypot(*(np.indices(shape) - 80))
    template = seen(cutout, shape)
    inside = [radius < r for r in (10, 20, 30, 40)]
    growth = [truth[one].sum() / template[one].sum() for one in inside]
    assert_allclose(growth, growth[0], rtol=0.01)
    # light beyond the image's noise
    assert_allclose(growth, 1.0, rtol=0.03)


@pytest.mark.parametrize("r_eff", [4.0, 6.0])
def test_light_beyond_a_template_is_part_of_the_total(r_eff):
    """A tenth of a de Vaucouleurs profile is beyond six half-light radii, where templates end."""
    shape, total = (161, 161), 1.0
    truth = galaxy(shape, 80, 80, r_eff=r_eff, n=4.0, q=0.8, flux=total)
    labels = (truth > 5e-4).astype(int)
    (cutout,) = cutouts_of(truth, 2e-5, labels, [(80, 80)], select=False)
    assert cutout.kind == "cutout"
    assert sum(layer.data.sum() for layer in cutout.layers) < 0.97
    # what the template has to be multiplied with to be the galaxy's bright part
    template, bright = seen(cutout, shape), labels > 0
    assert truth[bright].sum() / template[bright].sum() == pytest.approx(total, rel=0.02)


def test_templates_and_their_errors_do_not_depend_on_the_unit_of_light():
    """Light and errors times 50: shares of the light and relative errors are the same."""
    sigma = 0.002
    noise = np.random.default_rng(2).normal(0, sigma, (81, 81))
    knots = sum(gaussian_image(81, WIDTH, *at) for at in ((-4, 1), (5, -2)))
    image = 0.6 * galaxy((81, 81), 40, 40, r_eff=5.0, n=1.5, q=0.6) + 0.2 * knots + noise
    labels = (scipy.ndimage.gaussian_filter(image, 1.5) > 0.6 * sigma).astype(int)
    psf, one, place = gaussian_psf(), np.array([1]), np.array([[40.0, 40.0]])
    parts, lights = [], []
    for unit in (1.0, 50.0):
        fine = unit * image, np.full(image.shape, (unit * sigma) ** 2), psf, SCALE
        (cutout,), _, _, fitted = cutouts(*fine, labels, one, place, min_snr=5.0, select=False)
        parts.append(cutout)
        lights.append(fitted["light"][0])
    for layer, other in zip(parts[0].layers, parts[1].layers, strict=True):
        assert_allclose(other.data, layer.data, atol=1e-4 * np.abs(layer.data).max())
    assert_allclose(lights[1], lights[0], rtol=1e-3)
    assert_allclose(parts[1].noise, parts[0].noise, rtol=1e-3)
    # the variances of the pixels that are taken from the image, of a light of 1
    assert 50 < parts[0].noise / sigma**2 < np.count_nonzero(labels)


def test_neighbors_do_not_add_to_each_others_wings():
    shape, sigma = (121, 161), 1e-4
    places, light = np.array([[62.0, 60.0], [98.0, 60.0]]), np.array([1.0, 3.0])
    alone = [flux * galaxy(shape, x, y, r_eff=9.0, n=1.5, q=0.7)
             for (x, y), flux in zip(places, light, strict=True)]  # fmt: skip
    image = sum(alone) + np.random.default_rng(3).normal(0, sigma, shape)
    bright = scipy.ndimage.gaussian_filter(image, 1.5) > sigma
    labels = np.where(bright, 1 + np.argmax(alone, axis=0), 0)
    parts = cutouts_of(image, sigma, labels, places, n_psf=121)
    # fluxes by least squares, each pixel the same
    matrix = np.stack([seen(one, shape).ravel() for one in parts], axis=1)
    flux, *_ = np.linalg.lstsq(matrix, image.ravel())
    assert_allclose(flux, light, rtol=0.02)
    # each template holds its own light where the other's is
    for one, flux, template in zip(alone, light, matrix.T, strict=True):
        assert_allclose(template.reshape(shape)[:, :81].sum(), one[:, :81].sum() / flux, atol=0.02)
