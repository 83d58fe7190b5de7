"""
What happens between the sky and the counts, as small objects in one written order.

Each effect has one method, ``apply(array, block)``: array in, array out. What the array
is follows from the order: the scene's surface brightness (MJy/sr, shape (n_row, n_col))
until `Photons` turns it into a ramp of accumulated electrons, shape (n_int, n_group,
n_row, n_col); electrons until `Nonlinearity` turns them into DN; DN until `ADConversion`
makes unsigned integers of them. A ramp may be changed in place; the returned array is
the one that counts.

Effects act on blocks of full rows. What a row gets does not depend on the block it is in
(see `miricigale.detector._core`), so neither the height of the blocks nor the number of
threads changes a result, and a detector of any size needs little memory.
"""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
