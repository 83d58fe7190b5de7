"""Differences between the sky of a truth and what the analysis assumes."""

import dataclasses
import functools

import astropy.units as u
import numpy as np

from miricigale import psf, sed
from miricigale.instrument import flat_field, miri_detector
from miricigale.sed import components
from miricigale.utils.arrays import quiet_division
from miricigale.utils.random import stream
from miricigale.workflow.morphology import add_clumps

#: Mass fraction and time since the beginning (Gyr) of recent bursts, ends of their ranges.
BURST = {"f_burst": (0.001, 0.05), "age_burst": (0.02, 0.2)}
#: Ranges of the parameters of Draine & Li 2007.
DUST = {"u_min": (1.0, 20.0), "gamma": (0.005, 0.05), "q_pah": (1.1, 4.58)}
#: What is neither drawn nor fitted of the torus: another opening angle (deg) and extent.
TORUS = {"opening_angle": 50.0, "radius_ratio": 10.0}


@dataclasses.dataclass(frozen=True)
class Perturbation:
    """
    Sky and detector of a truth where they differ from what the reduction assumes.

    Parameters
    ----------
    effects : dict of str to float or dict or None
        Size by name, out of `~miricigale.workflow.truths.EFFECTS`; those that concern the models
        of the sources change nothing here.
    seed : int
        Seed of what is drawn.
    stamps : dict of int or str to `~miricigale.scene.Cutout`, optional
        By id, of the sources that have the light of real galaxies.
    """

    effects: dict
    seed: int
    stamps: dict = dataclasses.field(default_factory=dict)

    def _random(self, name, *key):
        return stream(self.seed, "perturb", name, *key)

    def _signed(self, name, filter):
        """Return the size of an effect with a random sign in each band; 0 without it."""
        return self.effects.get(name, 0.0) * self._random(name, filter).choice([-1.0, 1.0])

    def psf(self, filter):
        """
        Return the PSF of a band: of a telescope with another wavefront, wider or narrower.

        Parameters
        ----------
        filter : str
            Name of the band.

        Returns
        -------
        psf : `~miricigale.psf.InstrumentPSF`
        """
        seed = None
        if "psf" in self.effects:
            # the same telescope in all bands
            seed = int(self._random("psf").integers(2, 2**31))
        if seed is None:
            model = psf.miri_psf(filter)
        else:
            model = psf.miri_psf(filter, seed=seed)
        factor = 1.0 + self._signed("psf_width", filter)
        if factor == 1.0:
            return model
        # its values at offsets that are smaller by the factor, with the same light
        cell = model.pixel_scale / model.n_cells
        data = psf.psf_image(model, pixel_scale=cell / factor, shape=model.data.shape)
        return model.replace(data * model.n_cells**2, meta={"width_factor": factor})

    def fluxes(self, name, table, bands):
        """
        Change fluxes by the error of a zero point, which has a sign of its own in each band.

        Parameters
        ----------
        name : {"zero_point", "zero_point_existing"}
            The effect.
        table : `~astropy.table.QTable`
            With the columns ``bands``; it is not changed.
        bands : iterable of str
            Names of the bands.

        Returns
        -------
        table : `~astropy.table.QTable`
        """
        if not self.effects.get(name):
            return table
        table = table.copy()
        for band in bands:
            table[band] = table[band] * (1.0 + self._signed(name, band))
        return table

    def catalog(self, catalog, filter):
        """
        Return the sources as a band shows them: fluxes by its zero point, shifted by its astrometry, clumpy.

        Parameters
        ----------
        catalog : `~astropy.table.QTable`
            With ``sky`` and the column ``filter``; it is not changed.
        filter : str
            Name of the band.

        Returns
        -------
        catalog : `~astropy.table.QTable`
            Sources that have `stamps` have the profile ``"cutout"``; clumps are further rows.
        """
        catalog = self.fluxes("zero_point", catalog, [filter])
        if self.stamps:
            catalog = catalog.copy()
            real = np.isin(catalog["id"], list(self.stamps))
            catalog["profile"] = np.where(real, "cutout", np.asarray(catalog["profile"]))
        if self.effects.get("clumps"):
            catalog = add_clumps(
                catalog,
                filter,
                share=self.effects["clumps"],
                seed=self.seed,
                point=self.point_column(filter),
            )
        if self.effects.get("astrometry"):
            catalog = catalog.copy()
            shift = self.effects["astrometry"] * u.arcsec
            angle = self._random("astrometry", filter).uniform(0, 360) * u.deg
            catalog["sky"] = catalog["sky"].directional_offset_by(angle, shift)
        return catalog

    def point_column(self, filter):
        """Return the column of a catalog with the share of the light that is in a point, or None."""
        if "point_agn" in self.effects:
            return point_column(filter)
        return None

    @functools.cached_property
    def detector(self):
        """`~miricigale.instrument.DetectorProperties` with another gain and non-linearity."""
        nominal = miri_detector()
        detector = nominal.replace(gain=nominal.gain * (1.0 + self.effects.get("gain", 0.0)))
        if self.effects.get("linearity"):
            # at the full well the linear signal is other by the size, at lower ones in proportion
            terms = np.zeros(max(3, len(nominal.nonlinearity)))
            terms[: len(nominal.nonlinearity)] = nominal.nonlinearity
            terms[2] += self.effects["linearity"] / nominal.saturation_dn
            detector = detector.replace(nonlinearity=tuple(terms))
        return detector

    def with_flat(self, image, exposure):
        """
        Return the light that turns the known flat field into one that is in part another detector's.

        Parameters
        ----------
        image : `~astropy.nddata.CCDData`
            The noiseless sky; changed in place.
        exposure : `~miricigale.instrument.Exposure`
            How it is exposed.

        Returns
        -------
        image : `~astropy.nddata.CCDData`
        """
        if self.effects.get("flat"):
            seed = int(self._random("flat").integers(2**31))
            actual = flat_field(exposure.filter, subarray=exposure.subarray, seed=seed)
            assumed = flat_field(exposure.filter, subarray=exposure.subarray)
            image.data *= 1.0 + self.effects["flat"] * (actual / assumed - 1.0)
        return image


def point_column(filter):
    """Return the name of the column with the share of a band's light that is in a point."""
    return f"{filter}_point"


def perturbed_model(effects, *, agn):
    """
    Return the model of the sources of a truth where it is another than that of the fits.

    With ``"stars"`` the history ends in a burst, and gas shines; with ``"dust"`` dust is that of
    Draine & Li 2007 with its own parameters; with ``"torus"`` the torus is our own parametric one,
    of another opening angle and extent.

    Parameters
    ----------
    effects : iterable of str
        Names out of `~miricigale.workflow.truths.EFFECTS`.
    agn : bool
        Whether there is an AGN.

    Returns
    -------
    model : `~miricigale.sed.SEDModel` or None
        None where it is the model of the fits.
    """
    replaced = {}
    if "stars" in effects:
        replaced["sfh"] = components.DelayedSFH()
        replaced["nebular"] = components.Nebular()
    if "dust" in effects:
        replaced["dust"] = components.DraineLi2007()
    if "torus" in effects and agn:
        replaced["agn"] = components.ParametricTorus(**TORUS)
    if not replaced:
        return None
    parts = {part.role: part for part in sed.SEDModel.yang2021(agn=agn).components}
    return sed.SEDModel((parts | replaced).values())


def perturbed_parameters(effects, table, models, prior, *, seed):
    """
    Draw parameters of sources for the model of `perturbed_model`.

    Bursts and dust are drawn for each source from its own random stream, evenly in the logarithm
    of `BURST` and `DUST`; masses are such that the galaxies, without AGN, are as bright in the prior's
    band as before, and the dust's luminosity follows by energy balance.

    Parameters
    ----------
    effects : iterable of str
        Names out of `~miricigale.workflow.truths.EFFECTS`.
    table : `~astropy.table.QTable`
        With ``id`` and the parameters of the model of the fits; it is not changed.
    models : tuple of `~miricigale.sed.SEDModel`
        That of the fits, and that of the truth.
    prior : str
        The prior's band.
    seed : int
        Seed of the draws.

    Returns
    -------
    table : `~astropy.table.QTable`
    """
    changed = table.copy()
    for effect, ranges in (("stars", BURST), ("dust", DUST)):
        if effect in effects:
            streams = [stream(seed, "perturb", effect, str(key)) for key in table["id"]]
            # each stream gives the first parameter, then the second
            for name, ends in ranges.items():
                low, high = np.log(ends)
                changed[name] = np.array([np.exp(rng.uniform(low, high)) for rng in streams])
    # masses that keep the light in the prior's band
    fitted = galaxy_light(models[0], table, [prior])[prior].value
    perturbed = galaxy_light(models[1], changed, [prior])[prior].value
    usable = np.isfinite(fitted) & np.isfinite(perturbed) & (perturbed > 0)
    ratio = fitted / np.where(usable, perturbed, 1.0)
    changed["mass"] = changed["mass"] * np.where(usable, ratio, 1.0)
    return changed


def galaxy_light(model, parameters, bands):
    """Return the fluxes of a model without its AGN; as `~miricigale.sed.SEDModel.fluxes`."""
    parameters = parameters.copy()
    if model.has_agn:
        parameters["frac_agn"] = np.zeros(len(parameters))
    return model.fluxes(parameters, bands)


def point_columns(model, parameters, bands):
    """
    Return the shares of the light that the AGN have, where they are points at the centers of their galaxies.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`
        With AGN.
    parameters : `~astropy.table.QTable`
        Its parameters.
    bands : iterable of str
        Names of the bands.

    Returns
    -------
    columns : dict of str to `~numpy.ndarray`
        By `point_column`, 0 to 1; 0 where the source has no model.
    """
    galaxies = galaxy_light(model, parameters, bands)
    total = model.fluxes(parameters, bands)
    columns = {}
    for band in bands:
        with quiet_division():
            share = 1.0 - galaxies[band].value / total[band].value
        columns[point_column(band)] = np.clip(np.nan_to_num(share), 0.0, 1.0)
    return columns
