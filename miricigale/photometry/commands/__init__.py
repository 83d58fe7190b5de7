"""Photometry from files to files: inputs, patches, kernels, injection, pages."""
