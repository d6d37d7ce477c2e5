"""Scenes: their entries, scene files, and checks of scenes."""
