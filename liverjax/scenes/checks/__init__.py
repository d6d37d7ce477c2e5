"""Checks of a scene. Each file answers one question, and `liverjax.scenes.scene_checks` calls all of them."""
