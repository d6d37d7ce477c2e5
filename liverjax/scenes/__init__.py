"""Scenes (the input of a simulation): their entries, scene files, and checks."""
