"""Sweeps at several temperatures, shifted to one: a master curve."""
