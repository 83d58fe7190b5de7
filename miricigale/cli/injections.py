"""The command that injects sources."""

from miricigale.cli.catalogs import images_of
from miricigale.cli.options import chosen, workers

#: Options of photometry that are left to its defaults where they are not given.
_PHOTOMETRY = "max_shift background_order offset_order second_pass components"


def inject(args):
    """Inject sources into an image."""
    from miricigale.injection import Injection

    options = chosen(args, _PHOTOMETRY)
    image, highres = _image_and_prior(args)
    if highres is None:
        _refuse_prior_options(args)
    else:
        options |= chosen(args, "segmentation catalog psf_stars")
        options["kernel"] = args.kernel
    injection = Injection(
        args.sources,
        **chosen(args, "n_trials n_sources stars threshold preset seed"),
    )
    with workers(None, args.threads) as executor:
        result = injection.run(
            image,
            highres,
            folder=args.output,
            executor=executor,
            redo=args.redo,
            n_threads=args.threads,
            progress_bar=not args.no_progress,
            **options,
        )
    for question in ("detection", "forced"):
        curve = result.curve(question) if len(result.sources) else None
        if curve is not None:
            print(f"50 % limit, {question}: {curve.limit:.2f} ± {curve.limit_err:.2f} AB")
    made = "page: index.html" if len(result.sources) else "photometry: photometry.fits"
    print(f"{len(result.sources)} sources; {made} in {args.output}/")
    return 0


def _image_and_prior(args):
    """The image and the prior (or None), with their options."""
    if len(args.images) > 2:
        msg = f"wanted are an image and a prior, got {len(args.images)} files"
        raise ValueError(msg)
    (image,) = images_of(args, args.images[:1])
    if len(args.images) == 1:
        return image, None
    (highres,) = images_of(args, args.images[1:], "highres_")
    return image, highres


def _refuse_prior_options(args):
    """Refuse options that need a prior."""
    from miricigale.utils.exceptions import argument_error

    names = [name for name in vars(args) if name.startswith("highres_")]
    for name in (*names, "segmentation", "catalog", "kernel", "psf_stars"):
        value = getattr(args, name)
        if value is not None:
            flag = "--" + name.replace("_", "-")
            raise argument_error(flag, "given with a prior", value)
