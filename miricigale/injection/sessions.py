"""Injection of sources into real data: the class that a session uses."""

import dataclasses
from pathlib import Path

from miricigale.injection.ramps import Exposures
from miricigale.injection.settings import InjectionSettings
from miricigale.injection.stages import run_injection
from miricigale.reduction import Reducer
from miricigale.utils.interactive import Interactive
from miricigale.utils.named_values import field_values
from miricigale.utils.units import ANGLE
from miricigale.utils.values import value_class


@value_class
class Injection(Interactive, InjectionSettings):
    """
    Inject stars and galaxies into real images or ramps, and measure what becomes of them.

    Parameters
    ----------
    catalog : table in any form or path-like, optional
        Sources of your own: fluxes or magnitudes in the image's filter (and in the prior's, or colors are drawn
        from the field), and for galaxies ``half_light_radius``, ``sersic_index``, ``axis_ratio`` and
        ``position_angle``. They are injected in turn, at their positions if it has such (those without data in
        the image are left out) and otherwise at random places. By default sources are drawn: magnitudes that
        follow the field's counts down to 1 mag below its 5-sigma limit, with sizes and colors of its own sources
        of similar magnitude.
    n_trials : int, optional
        How often sources are injected and the field is measured.
    n_sources : int, optional
        Sources in each trial; by default a fifth of those of the field and 20 at least, if there is room so that
        they stay 6 widths of the PSF apart. With 0 the user's own result is repeated.
    stars : float, optional
        Share of stars among drawn sources.
    threshold : float, optional
        Signal-to-noise from which forced photometry counts as a recovery.
    preset : str or `~miricigale.photometry.DetectionPreset`, optional
        How sources are detected on the image.
    seed : int, optional
        Seed of every draw.

    Raises
    ------
    ValueError
        If a setting is out of range.

    Notes
    -----
    The injected light has its photon noise: in ramps always, in mosaics where they state what it is, by
    VAR_POISSON, or by electrons and an exposure time; ``result.meta["photon_noise"]`` says so. Light in the prior
    has none. Light is drawn with the PSF that photometry uses, so that a wrong PSF is not seen.

    References
    ----------
    Suchyta et al. 2016, MNRAS 457, 786 (Balrog); Huang et al. 2018, PASJ 70, S6 (SynPipe).

    Examples
    --------
    >>> from miricigale.injection import Injection
    >>> result = Injection(n_trials=20).run("f770w.fits", "f444w.fits", folder="injected")  # doctest: +SKIP
    >>> result.curve("detection").limit, result.curve("forced").limit  # doctest: +SKIP
    """

    replace = dataclasses.replace

    def __repr__(self):
        return f"<Injection {self.n_trials} trials, seed {self.seed}>"

    def _facts(self):
        return field_values(self)

    def run(
        self,
        image,
        highres=None,
        *,
        folder,
        executor=None,
        redo=False,
        n_threads=None,
        progress_bar=False,
        **options,
    ):
        """
        Inject sources and measure them, as `~miricigale.photometry.measure_files` does.

        Parameters
        ----------
        image : path-like or `~miricigale.photometry.MosaicFile`
            The image.
        highres : path-like or `~miricigale.photometry.MosaicFile`, optional
            The prior, into which sources are injected too. Without it positions and shapes of all sources are
            taken as known, and those of the field are detected on the image.
        folder : path-like
            Of the products: ``sources.fits`` (a row for each injected source), ``summary.ecsv``,
            ``purity.ecsv``, ``photometry.fits`` (the user's own result) and the page ``index.html``. The same
            call resumes there.
        executor : optional
            Processes, threads or a cluster that do trials side by side, as for
            `~miricigale.workflow.StudyRunner`; the products are the same bytes.
        redo : bool, optional
            Whether products of other files or settings in the folder are replaced, and trials are added to a
            finished run; otherwise they are refused.
        n_threads : int, optional
            Number of threads; all by default.
        progress_bar : bool, optional
            Whether progress is shown.
        **options
            With a prior, all others of `~miricigale.photometry.measure_files` that are not files to be written:
            ``segmentation``, ``catalog``, ``kernel``, ``max_shift`` and so on. Without, those of
            `~miricigale.photometry.ForcedPhotometer`; ``background_order`` is 0 and ``second_pass`` None by
            default, as with a prior.

        Returns
        -------
        result : `InjectionResult`

        Raises
        ------
        `~miricigale.utils.exceptions.OtherResultsError`
            If the folder holds what other files or settings made, and ``redo`` is False.
        `~miricigale.utils.exceptions.DataError`, ValueError
            As `~miricigale.photometry.measure_files`; if the field has too few sources to draw from, or no free
            place; if the folder is another's or in use.
        """
        return run_injection(
            self,
            image,
            highres,
            folder,
            executor=executor,
            redo=redo,
            n_threads=n_threads,
            progress_bar=progress_bar,
            options=options,
        )

    def run_exposures(
        self,
        paths,
        highres=None,
        *,
        folder,
        reducer=None,
        pixel_scale=0.11 * ANGLE,
        align=None,
        executor=None,
        redo=False,
        n_threads=None,
        progress_bar=False,
        **options,
    ):
        """
        Inject sources into ramps, reduce these, and measure the mosaic.

        Parameters
        ----------
        paths : iterable of path-like
            Level-1b files (``_uncal``) of one filter.
        highres
            As for `run`.
        folder : path-like
            As for `run`. The ramps as they are are reduced into ``<folder>-reduced`` beside it.
        reducer, pixel_scale, align : optional
            As for `~miricigale.reduction.reduce_files`. The references of the reducer are those by which light
            becomes counts.
        executor, redo, n_threads, progress_bar, **options
            As for `run`.

        Returns
        -------
        result : `InjectionResult`

        Raises
        ------
        `~miricigale.utils.exceptions.OtherResultsError`, `~miricigale.utils.exceptions.DataError`, ValueError
            As `run`; if a file is not level 1b or cannot be reduced, or files are of several filters.

        Notes
        -----
        Light goes through the model PSF of the detector at the middle of the field, the distortion, flat field
        and photometric conversion of the reduction, Poisson noise, interpixel capacitance and the inverse of
        the linearity (`miricigale.injection.ramps.inject_ramp`). All other noise is the ramp's own.
        """
        exposures = Exposures(
            tuple(paths), Reducer() if reducer is None else reducer, pixel_scale, align
        )
        folder = Path(folder)
        output = folder.with_name(f"{folder.name}-reduced")
        mosaic = exposures.reduce(output, n_threads=n_threads, progress_bar=progress_bar)
        return run_injection(
            self,
            mosaic,
            highres,
            folder,
            executor=executor,
            redo=redo,
            n_threads=n_threads,
            progress_bar=progress_bar,
            options=options,
            exposures=exposures,
        )
