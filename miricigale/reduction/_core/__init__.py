"""
Ramp fitting kernels: exact generalized least squares on group differences, with jumps.

Arrays only. Differences of consecutive groups of one segment (no jump inside) have the
covariance C = v I + s T, with v the Poisson variance of a difference, s the variance of a
single read and T = tridiag(-1, 2, -1). Being Toeplitz and tridiagonal, C has closed-form
inverse and weights. With x = v / s, l = exp(-theta) and 2 cosh(theta) = 2 + x,
f_i = 1 - l^i, and a segment of L differences (i = 1 ... L)::

    w_i       = (C^-1 1)_i = f_i f_(L+1-i) / (v (1 + l^(L+1)))
    slope     = sum(w d) / sum(w),   variance = 1 / sum(w)
    (C^-1)_ij = l^(j-i) h_i h_(L+1-j) / (s (1/l - l) h_(L+1)),  i <= j,  h_i = 1 - l^(2 i)

so that the residuals' C^-1 r needs one recursion forwards and one backwards. A jump at
difference j has the likelihood-ratio statistic t_j = (C^-1 r)_j / sqrt((C^-1)_jj - w_j^2 / W),
r the residuals from the common slope, W the sum of all weights: t_j^2 is the drop in chi
squared that a free difference j brings.

All integrations of a pixel share one slope and one Poisson variance.
"""
