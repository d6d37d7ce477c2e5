"""Small harmonic motion of a body at given frequencies, about its reference shape or about a loaded state."""
