"""Kernels that several subpackages share; arrays and numbers only."""
