from .ellipse import ellipse_to_pixels as ellipse_to_pixels
from .sersic import SERSIC_INDEX_RANGE as SERSIC_INDEX_RANGE
from .sersic import sersic_bn as sersic_bn
from .sersic import sersic_enclosed_fraction as sersic_enclosed_fraction
from .sersic import sersic_image as sersic_image
from .sersic import sersic_radius as sersic_radius
from .sersic import sersic_stamp as sersic_stamp
