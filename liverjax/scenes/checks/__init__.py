"""Checks of a scene, one question a file; `liverjax.scenes.scene_checks` asks all. Each refusal is one sentence."""
