"""Errors that a fit states about itself: ends of the band, choice of the model, total error."""
