"""Small motion at a frequency: harmonic waves in a body, about its reference shape or a loaded state."""
