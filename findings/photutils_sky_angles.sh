#!/usr/bin/env bash
# photutils turns an ellipse on the sky the wrong way in images whose east is on the right.
#
# Seen with photutils 3.0.0, regions 0.12 and astropy 7.2.0, an ellipse at position angle 30 degrees, converted to
# pixels, and the position angle of its major axis on the sky:
#   - 30 degrees where east is left (CDELT1 < 0), as it should be;
#   - 150 degrees where east is right (CDELT1 > 0), for ellipses and rectangles.
# regions 0.12 has the same position angle in both (0.11 has not). A good guess would be that an aperture on the sky covers the
# same sky in any image. No warning is given. Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "photutils==3.0.0" "regions==0.12" "astropy==7.2.0"
"$folder/venv/bin/python" - <<'PYTHON'
import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from photutils.aperture import SkyEllipticalAperture, SkyRectangularAperture
from regions import EllipseSkyRegion

center = SkyCoord(150.0, 2.0, unit="deg")


def image_wcs(cdelt1):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [150.0, 2.0]
    wcs.wcs.crpix = [51.0, 51.0]
    wcs.wcs.cdelt = [cdelt1, 1e-4]
    return wcs


def position_angle(wcs, angle):
    """Position angle, 0 to 180 degrees, of a direction in pixels."""
    end = wcs.pixel_to_world(50.0 + 10.0 * np.cos(angle), 50.0 + 10.0 * np.sin(angle))
    return round(float(center.position_angle(end).deg) % 180.0)


seen = {}
for cdelt1 in (-1e-4, 1e-4):
    wcs = image_wcs(cdelt1)
    sizes = (8 * u.arcsec, 3 * u.arcsec)
    ellipse = SkyEllipticalAperture(center, *sizes, theta=30 * u.deg).to_pixel(wcs)
    rectangle = SkyRectangularAperture(center, *sizes, theta=30 * u.deg).to_pixel(wcs)
    # angles of regions are from the west, not from the north
    region = EllipseSkyRegion(center, *sizes, angle=-60 * u.deg).to_pixel(wcs)
    angles = [u.Quantity(shape, u.rad).value for shape in (ellipse.theta, rectangle.theta)]
    angles.append(region.angle.to_value(u.rad))
    seen[cdelt1] = [position_angle(wcs, angle) for angle in angles]
    print(f"CDELT1 {cdelt1:+.0e}: photutils {seen[cdelt1][:2]}, regions {seen[cdelt1][2]} degrees")
assert seen == {-1e-4: [30, 30, 30], 1e-4: [150, 150, 30]}, seen
PYTHON
