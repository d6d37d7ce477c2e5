"""Errors of a fit in addition to noise: influence of the ends of the band, choice of the model, total error."""
