"""Least squares, uncertainty, the generalised Maxwell model, priors."""
