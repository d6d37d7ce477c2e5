"""Methods of the fits: least squares, uncertainty, the generalised Maxwell model and priors."""
