"""Where what stands: rows of the tables of models, vectors of the pairs side by side."""

from miricigale.fitting._core.structs import BLOCK

#: Rows of ``Tables.of_galaxy``: dust luminosity in W for each solar mass formed and its log10 (-400
#: where it is 0), 2 ln(prior), the galaxy's parts of the other fraction and of the quantity of both.
DUST, LOG_DUST, LOG_GALAXY, SHARE_GALAXY, MIXED_GALAXY = range(5)
#: Rows of ``Tables.of_agn``: 2 ln(prior), the AGN model's parts of these.
LOG_AGN, SHARE_AGN, MIXED_AGN = range(3)
#: Rows of ``Tables.of_frac``, fractions above 0: c = f / (1 - f), its log10 in bins, prior,
#: 2 ln(prior), c at the edges of the fractions' cells.
RATIO, LOG_RATIO, PRIOR_FRAC, LOG_FRAC, EDGE_LOW, EDGE_HIGH = range(6)

#: Offsets of the vectors in Lanes.buffer, which lets the compiler see that they do not overlap. What
# the pairs are, with A, X and B for x = c ...
P, Q, X2, A, B, PRIOR, SHARE, POWER = (i * BLOCK for i in range(8))
# ... sums over the fractions of prior * likelihood l, l s, l s^2, l c s, l c s^2, l c^2 s^2, the
# other fraction phi and its square, l of s = 0 and l (s / sigma_s)^2; the largest R, work space.
W0, W1, W2, V1, U2, V2, F1, F2, WZ, WR, TOP, T = (i * BLOCK for i in range(8, 20))
#: Number of vectors that say what the pairs are, and length of the whole buffer.
N_INPUT = 8
SIZE = 20 * BLOCK
