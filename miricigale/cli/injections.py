"""The command that injects sources."""

import math

from miricigale.cli.catalogs import images_of
from miricigale.cli.exposures import reducer_of
from miricigale.cli.options import TYPES, chosen, declarations, workers

#: Options of photometry that are left to its defaults where they are not given.
_PHOTOMETRY = "max_shift background_order offset_order second_pass components"

#: Options that need a prior, beside those of the prior itself.
_OF_PRIOR = ("segmentation", "catalog", "kernel", "psf_stars")


def inject(args):
    """Inject sources into an image or ramps."""
    from miricigale.injection import Injection
    from miricigale.injection.ramps import is_ramp

    images = args.images
    n_ramps = 0
    while n_ramps < len(images) and is_ramp(images[n_ramps].partition("[")[0]):
        n_ramps += 1
    ramps = images[:n_ramps]
    priors = images[max(n_ramps, 1) :]
    if len(priors) > 1:
        msg = f"wanted are an image, or ramps, and at most one prior, got {len(priors)} priors"
        raise ValueError(msg)
    options = chosen(args, _PHOTOMETRY)
    if priors:
        (highres,) = images_of(args, priors, "highres_")
        options |= chosen(args, "segmentation catalog psf_stars kernel")
    else:
        highres = None
        of_prior = [name for name in vars(args) if name.startswith("highres_")]
        _refuse(args, (*of_prior, *_OF_PRIOR), "given with a prior")
    injection = Injection(
        args.sources, **chosen(args, "n_trials n_sources stars threshold preset seed")
    )
    options["redo"] = args.redo
    options["folder"] = args.output
    options["n_threads"] = args.threads
    options["progress_bar"] = not args.no_progress
    with workers(None, args.threads) as executor:
        options["executor"] = executor
        if ramps:
            # an option of image and prior has both names
            of_image = sorted(name for name in vars(args) if f"highres_{name}" in vars(args))
            _refuse(args, of_image, "left out for ramps, whose mosaic states it")
            options |= chosen(args, "pixel_scale align")
            options["reducer"] = reducer_of(args)
            result = injection.run_exposures(ramps, highres, **options)
        else:
            _refuse_reduction(args)
            (image,) = images_of(args, images[:1])
            result = injection.run(image, highres, **options)
    if len(result.sources) == 0:
        print(f"0 sources; photometry: photometry.fits in {args.output}/")
        return 0
    for question in ("detection", "forced"):
        curve = result.curve(question)
        if curve is not None and math.isfinite(curve.limit):
            print(f"50 % limit, {question}: {curve.limit:.2f} ± {curve.limit_err:.2f} AB")
    print(f"{len(result.sources)} sources; page: index.html in {args.output}/")
    return 0


def _refuse(args, names, wanted):
    """Refuse options that mean nothing for what is given."""
    from miricigale.utils.exceptions import argument_error

    for name in names:
        value = getattr(args, name)
        if value is not None:
            raise argument_error(name, wanted, value)


def _refuse_reduction(args):
    """Refuse options of the reduction for an image that is one already."""
    from miricigale.utils.exceptions import argument_error

    declared = declarations()
    for flag in declared["inject"]["as_in"]["reduce"]:
        option = declared["reduce"]["options"][flag]
        name = flag.lstrip("-").replace("-", "_")
        default = option.get("default", False if option.get("action") else None)
        if isinstance(default, str) and "type" in option:
            default = TYPES[option["type"]](default)
        if getattr(args, name) != default:
            raise argument_error(name, "given for ramps (level 1b)", getattr(args, name))
