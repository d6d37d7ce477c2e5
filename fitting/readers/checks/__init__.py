"""Checks of measured rows: scatter of the load and of the phase, and responses in time that no material can have."""
