"""The command that injects sources."""

import math

from miricigale.cli.catalogs import images_of, photometer_options
from miricigale.cli.exposures import reducer_of
from miricigale.cli.options import declarations, destination, filled, refuse, workers
from miricigale.utils.named_values import attributes, without_none

#: Options that need a prior, besides those of the prior itself.
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
    options = photometer_options(args)
    if priors:
        (highres,) = images_of(args, priors, "highres_")
        options |= without_none(attributes(args, _OF_PRIOR))
    else:
        highres = None
        of_prior = [name for name in vars(args) if name.startswith("highres_")]
        refuse(args, (*of_prior, *_OF_PRIOR), "given with a prior")
    # --catalog is that of the prior
    injection = Injection(**filled(args, Injection) | {"catalog": args.sources})
    with workers(None, args.n_threads) as executor:
        options["executor"] = executor
        if ramps:
            # an option of image and prior has both names
            of_image = sorted(name for name in vars(args) if f"highres_{name}" in vars(args))
            refuse(args, of_image, "left out for ramps, whose mosaic states it")
            options |= filled(args, injection.run_exposures)
            options["reducer"] = reducer_of(args)
            result = injection.run_exposures(ramps, highres, **options)
        else:
            refuse(args, _options_of_reduction(), "given for ramps (level 1b)")
            (image,) = images_of(args, images[:1])
            options |= filled(args, injection.run)
            result = injection.run(image, highres, **options)
    if len(result.sources) == 0:
        print(f"0 sources; photometry: photometry.fits in {args.folder}/")
        return 0
    for question in ("detection", "forced"):
        curve = result.curve(question)
        if curve is not None and math.isfinite(curve.limit):
            print(f"50 % limit, {question}: {curve.limit:.2f} ± {curve.limit_err:.2f} AB")
    print(f"{len(result.sources)} sources; page: index.html in {args.folder}/")
    return 0


def _options_of_reduction():
    """Return the names of the options that are those of ``reduce``."""
    declared = declarations()
    names = []
    for flag in declared["inject"]["as_in"]["reduce"]:
        option = declared["reduce"]["options"][flag]
        names.append(destination(flag, option))
    return names
