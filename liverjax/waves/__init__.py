"""Small harmonic motion of a body at given frequencies. The body vibrates about its reference shape or about a loaded
state."""
