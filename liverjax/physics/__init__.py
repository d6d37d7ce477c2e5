"""The physics of a scene: elasticity, viscosity, porosity, contact, supports, loads and prescribed motions.

In this project a physics is one object that adds forces or constraints to a body. Most of them have a separate file.
"""
