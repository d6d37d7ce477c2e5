"""Models of the noise in residuals: noise that is correlated between neighbouring points, noise whose size differs
between points, and unknown factors of whole series."""
