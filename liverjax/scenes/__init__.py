"""Scenes: the parts of a scene, scene files, and checks of scenes."""
