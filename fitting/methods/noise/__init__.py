"""Models of noise that the residuals show: correlated noise of neighbouring points, and noise of different size."""
