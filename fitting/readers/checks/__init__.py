"""Checks of measured rows: scatter of the load and of the phase, and courses in time that no material has."""
