"""Further errors of a fit: influence of the ends of the band, choice of the model, total error."""
