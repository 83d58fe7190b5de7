"""
Numerical core of the detector: random numbers and what happens to charge, on arrays only.

Every kernel that draws gives each detector row (of each integration) its own
xoshiro256++ stream, seeded from four key words, the integration and the row. What a row
gets depends on nothing else, so blocks of any height on any number of threads give the
same numbers, and a kernel may draw a neighboring row again where it needs it.

All kernels release the interpreter lock. Ramps have shape (n_int, n_group, n_row, n_col),
float32; ``first_row`` is the detector row of the block's first row.
"""
