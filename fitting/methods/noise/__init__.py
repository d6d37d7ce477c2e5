"""Noise that residuals show: noise that neighbours share, or noise of different size at different points."""
