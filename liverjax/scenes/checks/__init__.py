"""Checks of a scene. Each file contains the checks of one kind. `liverjax.scenes.scene_checks` calls all of them."""
