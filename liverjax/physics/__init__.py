"""The physics of a scene: elasticity, viscosity, porosity, contact, supports, loads and prescribed motions.

In this project, "a physics" is one object that adds forces or constraints to a body, for example a support or an
obstacle. Most kinds of these objects have a separate file.
"""
